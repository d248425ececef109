"""Areas visible in two panoramas, against rooms whose rays are traced in closed form."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import (
    PanoramaPose,
    equirect_directions,
    lonlat_to_xyz,
    random_rotation,
    rotation_about,
    to_right_handed,
)
from tangent_train.keypoints.covisibility import (
    DepthView,
    correct_matches,
    fov_overlap,
    visible_from,
)
from tests.geometry.directions import angle_deg, random_directions, unit

Array = NDArray[np.float64]
SHAPE = (128, 256)


class Room(NamedTuple):
    """A box seen from inside, with boxes in it; corners as (low, high) in meters."""

    walls: tuple[Array, Array]
    boxes: tuple[tuple[Array, Array], ...] = ()

    def distance_m(self, center: Array, rays: Array) -> Array:
        """Distance to the first surface along unit rays ``(…, 3)``, by the slab method."""
        distance = _slabs(center, rays, *self.walls)[1]
        for low, high in self.boxes:
            near, far = _slabs(center, rays, low, high)
            distance = np.where((near <= far) & (near > 0), np.minimum(near, distance), distance)
        return distance

    def view(self, pose: PanoramaPose, shape: tuple[int, int] = SHAPE) -> DepthView:
        rays = equirect_directions(shape) @ pose.world_from_panorama.T
        return DepthView(self.distance_m(pose.location_m, rays).astype(np.float32), pose)

    def hidden(self, pose: PanoramaPose, points_m: Array) -> Array:
        """Distance in meters of points behind the first surface seen from a pose: 0 if visible."""
        offset = points_m - pose.location_m
        away = np.linalg.norm(offset, axis=-1)
        return away - self.distance_m(pose.location_m, offset / away[..., None])


def _slabs(center: Array, rays: Array, low: Array, high: Array) -> tuple[Array, Array]:
    with np.errstate(divide="ignore"):
        first, second = ((corner - center) / rays for corner in (low, high))
    return np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)


WALLS = (np.array([-3.0, -2, 0]), np.array([3.0, 2.5, 2.7]))
CUPBOARD = (np.array([-0.4, -0.5, 0]), np.array([0.3, 0.8, 1.9]))
SHELF = (np.array([-1.5, 1.5, 1.0]), np.array([1.0, 2.5, 1.2]))
ROOM = Room(WALLS, (CUPBOARD, SHELF))


def upright(place: tuple[float, float, float], heading_deg: float = 0) -> PanoramaPose:
    return PanoramaPose(to_right_handed(rotation_about((0, 0, 1), np.radians(heading_deg))), place)


def tilted(place: tuple[float, float, float], seed: int) -> PanoramaPose:
    return PanoramaPose(to_right_handed(random_rotation(np.random.default_rng(seed))), place)


LEFT, RIGHT = upright((-1.8, 0.2, 1.5), 20), upright((1.6, -0.4, 1.4), 170)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        # Poles and seam look anywhere: at edges of boxes and corners of the room.
        (tilted((-1.8, 0.2, 1.5), 1), tilted((1.6, -0.4, 1.4), 2)),
        # The cupboard straight below and above: behind the poles.
        (upright((-0.1, 0.1, 2.5)), upright((0.5, 0.1, 0.7), 45)),
    ],
)
def test_points_behind_a_box_are_hidden(left: PanoramaPose, right: PanoramaPose) -> None:
    views = ROOM.view(left), ROOM.view(right)
    directions = equirect_directions(SHAPE).reshape(-1, 3)
    shares = []
    for source, target in (views, views[::-1]):
        found = visible_from(directions, source, target)
        points_m = source.pose.points_m(directions, source.distance_m.reshape(-1))
        hidden_m = ROOM.hidden(target.pose, points_m)
        clearly_hidden, clearly_seen = hidden_m > 0.25, hidden_m < 1e-5
        assert clearly_hidden.mean() > 0.05
        # The map of the other panorama is as fine as its pixels: at its edges of depth, and on
        # surfaces seen edge-on, a pixel more or less is seen.
        assert found[clearly_seen].mean() > 0.96
        assert found[clearly_hidden].mean() < 0.03
        shares.append((hidden_m < 0.05).mean())
    assert fov_overlap(*views) == pytest.approx(np.mean(shares), abs=0.015)


def test_missing_depth_hides_nothing_and_is_not_counted() -> None:
    left, right = ROOM.view(LEFT), ROOM.view(RIGHT)
    directions = equirect_directions(SHAPE).reshape(-1, 3)
    full = visible_from(directions, left, right)
    holes = np.random.default_rng(2).random(SHAPE) < 0.3
    part = DepthView(np.where(holes, np.nan, left.distance_m), LEFT)
    blind = DepthView(np.full(SHAPE, np.nan), RIGHT)
    # A point without depth is not counted; missing depth in the target does not hide it.
    np.testing.assert_array_equal(visible_from(directions, part, right), full & ~holes.reshape(-1))
    assert visible_from(directions, left, blind).all()
    assert not visible_from(directions, blind, left).any()
    assert np.isnan(fov_overlap(left, blind))
    ray = np.array([[1.0, 0, 0]])
    neither, one = (correct_matches(ray, ray, view, blind) for view in (blind, right))
    assert np.array(neither).tolist() == [[False], [False]]
    assert np.array(one).tolist() == [[True], [True]]


def test_distances_between_pixels_of_a_wall_are_exact() -> None:
    view = Room(WALLS).view(LEFT)
    # All around the seam and both poles, between pixel centers.
    lonlat = np.stack([np.linspace(-np.pi, np.pi, 500), np.linspace(-1.57, 1.57, 500)], axis=-1)
    rays = lonlat_to_xyz(lonlat)
    expected = Room(WALLS).distance_m(LEFT.location_m, rays @ LEFT.world_from_panorama.T)
    distance_m, reach_m = view.distances(rays)
    error = np.abs(distance_m / expected - 1)
    assert np.median(error) < 2e-4
    assert error.max() < 0.03  # in corners of the room
    np.testing.assert_allclose(reach_m, distance_m, rtol=1e-6)


def test_matches_of_the_same_point_are_correct() -> None:
    left, right = ROOM.view(LEFT, (256, 512)), ROOM.view(tilted((1.6, -0.4, 1.4), 5), (256, 512))
    rng = np.random.default_rng(3)
    rays = random_directions(3000)
    points_m = left.pose.points_m(
        rays, ROOM.distance_m(LEFT.location_m, rays @ LEFT.world_from_panorama.T)
    )
    seen, _ = right.pose.project(points_m)
    visible = ROOM.hidden(right.pose, points_m) < 1e-6
    correct, known = correct_matches(rays[visible], seen[visible], left, right)
    assert known.all()
    assert correct.mean() > 0.998
    # Moved by 3°, or with another one's partner, they are not.
    moved = unit(seen + np.tan(np.radians(3)) * unit(np.cross(seen, rng.normal(size=seen.shape))))
    far = angle_deg(moved, seen) > 2.9
    assert correct_matches(rays, moved, left, right)[0][far & visible].mean() < 0.03
    assert correct_matches(rays, np.roll(seen, 1, axis=0), left, right)[0].mean() < 0.01
