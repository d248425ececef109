from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from datamodules.synthrooms.furniture import build_empty_room
from datamodules.synthrooms.render import (
    MISSING,
    Camera,
    Picture,
    RayScene,
    View,
    draw_view,
    render_picture,
)
from datamodules.synthrooms.room import FloorPlan, Light, Room
from tangent_train.geometry import equirect_directions, rotation_about, to_right_handed

SIZE = np.array([5.0, 4.0, 3.0])
HERE = np.array([1.5, 2.2, 1.4])
NO_HOLES = np.zeros((0, 4))


def empty_room() -> Room:
    """A lamp under the ceiling, which can be seen by its light only."""
    rng = np.random.default_rng(0)
    room = build_empty_room(rng, FloorPlan((5.0, 4.0, 3.0)))
    room.parts[:] = [
        part for part in room.parts if len(part.triangles) and _is_slab(part.triangles)
    ]
    down = np.array([0, 0, -1.0])
    sides = np.array([[0.2, 0, 0], [0, 0.2, 0]])
    room.lights.append(Light(np.array([2.5, 2.0, 2.9]), sides, down, 2.0))
    return room


def _is_slab(triangles: NDArray[Any]) -> bool:
    """Walls, floor and ceiling are 10 cm thick; carpets and skirting are not."""
    return bool(np.isclose(np.ptp(triangles, axis=(0, 1)).min(), 0.1))


def take(view: View, holes: NDArray[np.float64] = NO_HOLES) -> Picture:
    camera = Camera(HERE, 0.0, (0.0, 0.0), np.full(3, 3.0, np.float32), 0.0)
    return render_picture(RayScene(empty_room()), view, camera, holes, 2)


def test_distances_in_an_empty_box_are_those_of_its_planes() -> None:
    view = View.looking(HERE, 64, heading=0.7)
    rays = view.rays().astype(np.float64)
    with np.errstate(divide="ignore"):
        expected = np.where(rays > 0, (SIZE - HERE) / rays, -HERE / rays).min(axis=-1)
    depth = take(view).depth_m
    seen = ~np.isnan(depth)
    assert seen.mean() > 0.99
    np.testing.assert_allclose(depth[seen], expected[seen], atol=1e-4)


def test_unscanned_surfaces_have_a_color_but_no_label_or_depth() -> None:
    view = View.looking(HERE, 64, heading=0.0)
    whole = take(view)
    wall = HERE + np.array([3.5, 0, 0])
    holed = take(view, np.array([[*wall, 0.5]]))
    # The ball meets the wall in a disc; its ragged radius is between 0.43 and 0.56 m.
    points = HERE + view.rays() * np.nan_to_num(whole.depth_m)[..., None]
    away = np.linalg.norm(points - wall, axis=-1)
    assert np.isnan(holed.depth_m[away < 0.4]).all()
    assert (holed.items[away < 0.4] == MISSING).all()
    np.testing.assert_array_equal(holed.items[away > 0.6], whole.items[away > 0.6])
    np.testing.assert_array_equal(holed.rgb, whole.rgb)


# --- cameras --------------------------------------------------------------------------------------


PLACE = np.array([1.0, 2.0, 1.5])


def test_panorama_rays_are_the_sphere_mirrored_and_turned_by_the_heading() -> None:
    view = View.looking(PLACE, 16, heading=0.7)
    expected = equirect_directions((16, 32)) @ to_right_handed(rotation_about((0, 0, 1), 0.7)).T
    np.testing.assert_allclose(view.rays(), expected, atol=1e-6)


def test_perspective_rays_project_to_their_pixels() -> None:
    view = View.looking(PLACE, 9, math.radians(60), heading=0.4, pitch=0.2, roll=0.1)
    rays = view.rays()
    projected = rays @ view.world_from_camera @ view.camera_matrix.T
    pixels = projected[..., :2] / projected[..., 2:]
    columns, rows = np.meshgrid(np.arange(9), np.arange(9))
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), atol=1e-4)
    np.testing.assert_allclose(rays[4, 4], view.world_from_camera[:, 2], atol=1e-6)
    # The edge columns' outer sides span the field of view.
    edges = [view.rays(dx=dx)[4, j] for dx, j in ((-0.5, 0), (0.5, 8))]
    assert math.acos(float(edges[0] @ edges[1])) == pytest.approx(math.radians(60), abs=1e-3)


def test_views_look_around_as_asked() -> None:
    rng = np.random.default_rng(0)
    up = {
        kind: np.array(
            [draw_view(rng, kind, PLACE, 8).world_from_camera[2, 2] for _ in range(2000)]
        )
        for kind in ("uniform", "stanford", "wide")
    }
    # Archimedes: the height of uniform directions is uniform in [-1, 1], with variance 1/3.
    assert up["uniform"].var() == pytest.approx(1 / 3, abs=0.02)
    assert abs(up["uniform"].mean()) < 0.05
    assert np.degrees(np.arcsin(up["stanford"])).std() == pytest.approx(20, abs=1.5)
    assert np.degrees(np.arcsin(up["wide"])).std() == pytest.approx(34, abs=2)
