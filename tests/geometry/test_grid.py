"""Tangent images: textbook gnomonic formulas, rotations, errors."""

from __future__ import annotations

import math
import pickle
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import SphericalVoronoi

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    RingGrid,
    TangentGrid,
    rotation_about,
    xyz_to_lonlat,
)

ROTATION = rotation_about((1, 2, -3), 1.1)
RINGS = [{"pitch": pitch, "views": 6} for pitch in (0, 45, -45)]


@pytest.mark.parametrize("rotation", [None, ROTATION])
def test_project_is_the_inverse_of_directions(rotation: NDArray[np.float64] | None) -> None:
    grid = TangentGrid(1, 5, dim=20, rotation=rotation)
    faces = [0, 5, 42, 79]
    pixels = grid.project(7.0 * grid.directions(faces), np.array(faces)[:, None, None])
    rows, columns = np.mgrid[:20, :20]
    expected = np.broadcast_to(np.stack([columns, rows], axis=-1), pixels.shape)
    np.testing.assert_allclose(pixels, expected, atol=1e-11)
    homogeneous = grid.directions([5])[0] @ grid.world_from_camera[5] @ grid.camera_matrix.T
    np.testing.assert_allclose(homogeneous[..., :2] / homogeneous[..., 2:], expected[0], atol=1e-11)
    assert grid.directions([]).shape == (0, 20, 20, 3)


@pytest.mark.parametrize("faces", [[20], [-1], [0.5], [[0, 1]], [True, False]])
def test_impossible_faces_are_refused(faces: list[int]) -> None:
    with pytest.raises(SettingError, match=r"faces: found .*; expected indices 0 to 19"):
        TangentGrid(0, 4).directions(faces)


def test_grids_are_compared_by_value() -> None:
    grid, cube = TangentGrid(0, 5), CubeGrid(32)
    different: list[PinholeGrid] = [
        grid,
        TangentGrid(1, 5),
        TangentGrid(0, 6),
        TangentGrid(0, 5, 30),
    ]
    different += [cube, CubeGrid(33), CubeGrid(32, margin=1), RingGrid(RINGS, (100, 100), (8, 8))]
    different += [grid.with_rotation(ROTATION), cube.with_rotation(ROTATION)]
    different += [grid.resized((33, 33)), grid.subset([3, 4]), grid.subset([3, 5])]
    assert len(set(different)) == len({hash(grid) for grid in different}) == len(different)
    for one in different:
        again = pickle.loads(pickle.dumps(one))
        assert (again, hash(again)) == (one, hash(one))
    assert TangentGrid(0, 5) == TangentGrid(0, 5, 32)
    assert CubeGrid(32, ROTATION) == CubeGrid(32, ROTATION.tolist())
    assert CubeGrid(32).widened(1) == CubeGrid(34, margin=1) != CubeGrid(34)
    assert CubeGrid(32) != (32, None)


@pytest.mark.parametrize(
    "original", [CubeGrid(8, ROTATION), TangentGrid(1, 5), TangentGrid(0, 4, 20, ROTATION)]
)
@pytest.mark.parametrize("dim", [2, 7, 33])
def test_a_resized_grid_has_other_pixels(original: CubeGrid | TangentGrid, dim: int) -> None:
    grid = original.resized((dim, dim))
    assert grid.dim == dim
    assert grid.dim * grid.pitch == pytest.approx(original.dim * original.pitch, rel=1e-15)
    assert grid.num_images == original.num_images
    assert grid.is_overlapping is original.is_overlapping
    np.testing.assert_array_equal(grid.rotation, original.rotation)
    np.testing.assert_array_equal(grid.neighbors, original.neighbors)
    np.testing.assert_array_equal(grid.world_from_camera, original.world_from_camera)
    assert grid.with_rotation(ROTATION.T) == original.with_rotation(ROTATION.T).resized((dim, dim))
    # The outer edges agree: the middle of d pixels is (d − 1)/2.
    edges = original.project(grid.directions([3])[0, 0, 0], 3)
    np.testing.assert_allclose((edges + 0.5) * dim / original.dim, 0.5, atol=1e-9)


@lru_cache
def voronoi_extent(base_level: int) -> float:
    """Largest |x| or |y| of a cell corner on its own tangent plane, by textbook projection."""
    centers = TangentGrid(base_level, base_level + 6).centers_xyz
    voronoi = SphericalVoronoi(centers, threshold=1e-9)
    cell = np.repeat(np.arange(len(centers)), [len(region) for region in voronoi.regions])
    corners = voronoi.vertices[np.concatenate(voronoi.regions).astype(int)]
    (lon_0, lat_0), (lon, lat) = xyz_to_lonlat(centers)[cell].T, xyz_to_lonlat(corners).T
    cos_c = np.sin(lat_0) * np.sin(lat) + np.cos(lat_0) * np.cos(lat) * np.cos(lon - lon_0)
    x = np.cos(lat) * np.sin(lon - lon_0) / cos_c
    y = (np.cos(lat_0) * np.sin(lat) - np.sin(lat_0) * np.cos(lat) * np.cos(lon - lon_0)) / cos_c
    return float(np.abs([x, y]).max())


@pytest.mark.parametrize("base_level", range(5))
@pytest.mark.parametrize("finer", [3, 4, 6])
def test_least_dim_covers_the_voronoi_cells_exactly(base_level: int, finer: int) -> None:
    level = base_level + finer
    pitch = TangentGrid(base_level, level).pitch
    least = math.ceil(2 * voronoi_extent(base_level) / pitch) + 1
    with pytest.raises(SettingError, match=f"dim: found {least - 1}; expected at least {least} "):
        TangentGrid(base_level, level, least - 1)
    assert TangentGrid(base_level, level, least).half_extent >= voronoi_extent(base_level)
    assert TangentGrid.least_dim(base_level, level) == least


def test_the_width_is_the_angle_between_outer_pixel_edges() -> None:
    for base_level, width_deg in enumerate((95.82, 57.94, 32.83, 17.01, 8.59)):
        grid = TangentGrid(base_level, 10)
        edges = (np.array([-0.5, grid.dim - 0.5]) - grid.camera_matrix[0, 2]) * grid.pitch
        assert grid.width_deg == pytest.approx(np.degrees(np.ptp(np.arctan(edges))))
        assert grid.width_deg == pytest.approx(width_deg, abs=0.005)
