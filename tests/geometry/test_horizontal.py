"""Horizontal views: directions, owners and coverage, by other formulas and by brute force."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    RingGrid,
    TangentGrid,
    equirect_directions,
    rotation_about,
)
from tangent_train.rendering.tables import owners
from tests.geometry.directions import angle_deg, random_directions

ROTATION = rotation_about((1, 2, -3), 1.1)
STANDARD = ((0, 8), (40, 5), (-40, 5))


def grid_of(
    rings: tuple[tuple[float, int], ...],
    fov: tuple[float, float] = (100, 100),
    size: tuple[int, int] = (16, 16),
    **settings: Any,
) -> RingGrid:
    return RingGrid([{"pitch": pitch, "views": n} for pitch, n in rings], fov, size, **settings)


@pytest.mark.parametrize("rotation", [None, ROTATION])
def test_views_are_yawed_and_pitched_but_not_rolled(rotation: NDArray[np.float64] | None) -> None:
    """Compared with a camera at longitude 0 that is pitched, then yawed around the vertical."""
    grid = grid_of(((0, 8), (50, 4), (-50, 4)), (70, 90), (20, 15), rotation=rotation)
    tangent = math.tan(math.radians(45)) * 2 / 20  # the vertical field of view is decisive
    assert grid.pitch == pytest.approx(tangent)
    view = 0
    for pitch_deg, views in ((0, 8), (50, 4), (-50, 4)):
        for yaw_deg in np.arange(views) * 360 / views:
            around = rotation_about((0, 0, 1), math.radians(yaw_deg))
            camera = around @ rotation_about((0, 1, 0), -math.radians(pitch_deg))
            for row, column in ((0, 0), (19, 14), (3, 11)):
                seen = [1, (column - 7) * tangent, -(row - 9.5) * tangent]
                expected = (np.eye(3) if rotation is None else rotation) @ camera @ seen
                found = grid.directions([view])[0, row, column]
                assert angle_deg(found, expected) < 1e-9
                pixel = grid.project(3 * expected, view)
                np.testing.assert_allclose(pixel, (column, row), atol=1e-9)
            view += 1
    assert view == grid.num_images


def test_rings_can_be_a_cube() -> None:
    order = [0, 1, 2, 3, 5, 4]
    rings = grid_of(((0, 4), (-90, 1), (90, 1)), (90, 90), (8, 8))
    np.testing.assert_allclose(rings.directions(order), CubeGrid(8).directions(), atol=1e-12)
    assert rings.is_overlapping is False
    assert grid_of(((0, 4), (90, 1), (-90, 1)), (91, 91)).is_overlapping


GRIDS = [
    grid_of(STANDARD),
    grid_of(((10, 7), (90, 1), (-40, 3)), (150, 110), rotation=ROTATION),
    TangentGrid(1, 5).subset([3, 4, 17, 40, 41, 79]),
    CubeGrid(8, ROTATION).subset([0, 1, 2, 3]),  # centers in a plane
    TangentGrid(0, 5).subset([7]),
    TangentGrid(0, 5).subset([7, 3]),
]


@pytest.mark.parametrize("grid", GRIDS)
def test_owners_are_the_nearest_centers(grid: PinholeGrid) -> None:
    nearness = equirect_directions((45, 90)) @ grid.centers_xyz.T
    found = owners(grid, (45, 90))
    of_owner = np.take_along_axis(nearness, found[..., None].astype(int), axis=-1)[..., 0]
    np.testing.assert_allclose(of_owner, nearness.max(axis=-1), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_coverage_agrees_with_random_directions(seed: int) -> None:
    """Grids around the smallest field of view that covers the sphere, found by bisection."""
    rng = np.random.default_rng(seed)
    rings = ((0, 6), (float(rng.uniform(35, 60)), 4), (float(rng.uniform(-60, -35)), 5))
    ratio = float(rng.uniform(0.8, 1.2))

    def makes(fov: float, by_owners: bool) -> PinholeGrid | None:
        try:
            return grid_of(rings, (fov, 1), (round(100 * ratio), 100), by_owners=by_owners)
        except SettingError:
            return None

    directions = random_directions(100_000, seed)
    for by_owners in (True, False):
        low, high = 40.0, 140.0
        while high - low > 0.5:
            middle = (low + high) / 2
            low, high = (low, middle) if makes(middle, by_owners) else (middle, high)
        for fov, is_covered in ((low - 1, False), (high + 1, True)):
            grid = makes(high, by_owners)
            assert grid is not None
            pitch = 2 * math.tan(math.radians(fov / 2)) / 100
            grid = PinholeGrid(grid.world_from_camera, grid.size, pitch)
            pixels = grid.project(directions[:, None], np.arange(15))
            outer = np.array(grid.size[::-1]) / 2
            with np.errstate(invalid="ignore"):
                shown = (np.abs(pixels - outer + 0.5) <= outer).all(axis=-1)
            if by_owners:
                owner = (directions @ grid.centers_xyz.T).argmax(axis=1)
                shown = np.take_along_axis(shown, owner[:, None], axis=1)
            assert bool(np.any(shown, axis=1).all()) is is_covered


@pytest.mark.parametrize(
    ("rings", "fov", "message"),
    [
        (((0, 8),), (100, 100), r"8 views that miss longitude .*°, latitude -?\d\d°; expected"),
        (
            ((0, 4), (90, 1), (-90, 1)),
            (89, 89),
            r"6 views that miss longitude -?\d+°, latitude -?\d\d°",
        ),
    ],
)
@pytest.mark.parametrize("by_owners", [True, False])
def test_gaps_are_refused(rings: Any, fov: Any, message: str, by_owners: bool) -> None:
    with pytest.raises(SettingError, match=f"views: found {message}"):
        grid_of(rings, fov, by_owners=by_owners)


def test_a_direction_may_be_shown_by_another_view_than_its_owner() -> None:
    """Narrow views overlap far more above and below than at their sides."""
    rings, fov, size = ((0, 8), (75, 4), (-75, 4)), (47.0, 124.0), (52, 12)
    grid_of(rings, fov, size, by_owners=False)
    with pytest.raises(SettingError, match=r"nearest center \(blend=nearest\)"):
        grid_of(rings, fov, size, by_owners=True)
