"""Polygons of what images own, against ownership itself, scipy's Voronoi cells and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import dblquad
from scipy.spatial import SphericalVoronoi

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    TangentGrid,
    equirect_directions,
    equirect_solid_angles,
    random_rotation,
)
from tangent_train.geometry.owned_cells import mean_over_owned, owned_polygons

GRIDS: list[PinholeGrid] = [CubeGrid(8), *(TangentGrid(b, b + 5) for b in range(4))]


def test_cube_faces_own_squares() -> None:
    corners = owned_polygons(CubeGrid(8))
    assert corners.shape == (6, 4, 2)
    np.testing.assert_allclose(np.abs(corners), 1, atol=1e-12)


@pytest.mark.parametrize("grid", GRIDS)
def test_corners_are_as_near_to_three_centres_and_to_none_nearer(grid: PinholeGrid) -> None:
    corners = owned_polygons(grid)
    rays = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    directions = np.einsum("nkc,nwc->nkw", rays, grid.world_from_camera)
    closeness = np.sort(directions @ grid.centers_xyz.T, axis=-1)
    own = np.einsum("nkw,nw->nk", directions, grid.centers_xyz)
    np.testing.assert_allclose(own, closeness[..., -1], atol=1e-9)
    np.testing.assert_allclose(closeness[..., -3], closeness[..., -1], atol=1e-9)


@pytest.mark.parametrize("base_level", range(1, 4))
def test_the_polygons_are_scipys_voronoi_cells(base_level: int) -> None:
    grid = TangentGrid(base_level, base_level + 5)
    expected = SphericalVoronoi(grid.centers_xyz).calculate_areas()
    np.testing.assert_allclose(_solid_angles(grid), expected, rtol=1e-9)


def _solid_angles(grid: PinholeGrid) -> NDArray[np.float64]:
    """Of the polygons, by van Oosterom and Strackee's formula for triangles."""
    corners = owned_polygons(grid)
    rays = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=-1)
    b = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    c = np.roll(b, -1, axis=1)
    a = np.array([0.0, 0.0, 1.0])
    triple = np.cross(b, c) @ a
    return 2 * np.arctan2(triple, 1 + b @ a + (b * c).sum(-1) + c @ a).sum(axis=1)


@pytest.mark.parametrize("base_level", range(4))
def test_they_reach_as_far_as_the_grid_says(base_level: int) -> None:
    level = base_level + 12
    grid = TangentGrid(base_level, level)
    reach = np.abs(owned_polygons(grid)).max()
    assert TangentGrid.least_dim(base_level, level) == math.ceil(2 * reach / grid.pitch - 1e-9) + 1


@pytest.mark.parametrize("grid", GRIDS)
def test_they_cover_the_sphere_once(grid: PinholeGrid) -> None:
    assert _solid_angles(grid).sum() == pytest.approx(4 * math.pi, rel=1e-12)
    assert mean_over_owned(grid, np.ones_like) == pytest.approx(1, abs=1e-12)


def test_the_images_below_one_face_stand_for_all() -> None:
    grid = TangentGrid(2, 7)
    means = [mean_over_owned(grid, np.sin, faces) for faces in (None, range(16), range(32, 48))]
    np.testing.assert_allclose(means, means[0], rtol=1e-12)
    with pytest.raises(SettingError, match="faces"):
        mean_over_owned(grid, np.sin, range(319, 321))


def test_a_turn_changes_no_mean() -> None:
    grid = TangentGrid(1, 6)
    turned = grid.with_rotation(random_rotation(np.random.default_rng(3)))
    assert mean_over_owned(turned, np.cos) == pytest.approx(mean_over_owned(grid, np.cos), abs=1e-9)


@pytest.mark.parametrize("grid", GRIDS)
def test_means_agree_with_sums_over_a_panorama(grid: PinholeGrid) -> None:
    shape = (128, 256)
    directions = equirect_directions(shape)
    angle = np.arccos(np.clip((directions @ grid.centers_xyz.T).max(axis=-1), -1, 1))
    weights = np.broadcast_to(equirect_solid_angles(shape)[:, None], shape)
    expected = np.average(angle, weights=weights)
    assert mean_over_owned(grid, lambda found: found) == pytest.approx(expected, rel=1e-3)


def test_the_mean_scale_of_areas_is_the_planes_area_over_the_spheres() -> None:
    mean = mean_over_owned(CubeGrid(8), lambda angle: 1 / np.cos(angle) ** 3)
    assert mean == pytest.approx(6 * 4 / (4 * math.pi), rel=1e-12)


def test_a_kinked_function_is_integrated_well_enough() -> None:
    def deviation(angle: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.abs(1 / np.cos(angle) ** 3 * math.pi / 6 - 1)

    def over_the_face(y: float, x: float) -> float:
        secant = math.sqrt(1 + x * x + y * y)
        return abs(secant**3 * math.pi / 6 - 1) / secant**3

    # An eighth of a face.
    expected, _ = dblquad(over_the_face, 0, 1, 0, lambda x: x, epsabs=1e-6)
    found = mean_over_owned(CubeGrid(8), deviation)
    assert found == pytest.approx(48 * expected / (4 * math.pi), rel=1e-3)
