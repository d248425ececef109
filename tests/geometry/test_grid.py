"""Tangent images: constants of the paper, textbook gnomonic formulas, cameras, errors."""

from __future__ import annotations

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    TangentGrid,
    lonlat_to_xyz,
    rotation_about,
    vertex_resolution,
    xyz_to_lonlat,
)

TURN = rotation_about((1, 2, -3), 1.1)


def inverse_gnomonic(
    x: NDArray[np.float64], y: NDArray[np.float64], lon_0: float, lat_0: float
) -> NDArray[np.float64]:
    """Longitude and latitude of plane points (Snyder 1987, equations 20-14, 20-15 and 22-1)."""
    rho = np.maximum(np.hypot(x, y), np.finfo(float).tiny)
    c = np.arctan(rho)
    lat = np.arcsin(np.cos(c) * np.sin(lat_0) + y * np.sin(c) * np.cos(lat_0) / rho)
    lon = lon_0 + np.arctan2(
        x * np.sin(c), rho * np.cos(lat_0) * np.cos(c) - y * np.sin(lat_0) * np.sin(c)
    )
    return np.stack([lon, lat], axis=-1)


@pytest.mark.parametrize(
    ("base_level", "num_images", "dim", "fov_deg"),
    [(0, 20, 1024, 73.1345), (1, 80, 512, 51.6162), (2, 320, 256, 31.4503),
     (3, 1280, 128, 16.6995), (4, 5120, 64, 8.4306)],
)  # fmt: skip
def test_constants_of_level_10(base_level: int, num_images: int, dim: int, fov_deg: float) -> None:
    grid = TangentGrid(base_level, 10)
    assert (grid.num_images, grid.dim) == (num_images, dim)
    assert grid.fov_deg == pytest.approx(fov_deg, abs=5.1e-5)
    half_extent = (dim - 1) / (2 * dim) * vertex_resolution(base_level - 1)  # paper's bounds
    assert grid.half_extent == pytest.approx(half_extent, rel=1e-14)
    assert grid.centers_xyz.shape == (num_images, 3)
    np.testing.assert_allclose(np.linalg.norm(grid.centers_xyz, axis=1), 1, atol=1e-14)


@pytest.mark.parametrize(("base_level", "level", "dim"), [(0, 5, None), (1, 5, 13), (2, 5, 20)])
def test_directions_follow_the_textbook_formulas(
    base_level: int, level: int, dim: int | None
) -> None:
    grid = TangentGrid(base_level, level, dim)
    pitch = vertex_resolution(base_level - 1) / 2 ** (level - base_level)
    line = (np.arange(grid.dim) - (grid.dim - 1) / 2) * pitch
    x, y = np.meshgrid(line, -line)  # columns to the east, rows to the south
    directions = grid.directions()
    assert directions.shape == (grid.num_images, grid.dim, grid.dim, 3)
    for face, (lon_0, lat_0) in enumerate(xyz_to_lonlat(grid.centers_xyz)):
        expected = lonlat_to_xyz(inverse_gnomonic(x, y, lon_0, lat_0))
        np.testing.assert_allclose(directions[face], expected, atol=1e-13)


@pytest.mark.parametrize("rotation", [None, TURN])
def test_project_is_the_inverse_of_directions(rotation: NDArray[np.float64] | None) -> None:
    grid = TangentGrid(1, 5, dim=20, rotation=rotation)
    faces = [0, 5, 42, 79]
    pixels = grid.project(7.0 * grid.directions(faces), np.array(faces)[:, None, None])
    rows, columns = np.mgrid[:20, :20]
    expected = np.broadcast_to(np.stack([columns, rows], axis=-1), pixels.shape)
    np.testing.assert_allclose(pixels, expected, atol=1e-11)


def test_rotation_turns_every_direction() -> None:
    plain, turned = TangentGrid(1, 4), TangentGrid(1, 4, rotation=TURN)
    np.testing.assert_allclose(turned.centers_xyz, plain.centers_xyz @ TURN.T, atol=1e-14)
    np.testing.assert_allclose(turned.directions(), plain.directions() @ TURN.T, atol=1e-14)
    directions = np.random.default_rng(0).normal(size=(200, 3))
    np.testing.assert_array_equal(turned.owners(directions @ TURN.T), plain.owners(directions))


@pytest.mark.parametrize("faces", [[20], [-1], [0.5], [[0, 1]], [True, False]])
def test_impossible_faces_are_refused(faces: list[int]) -> None:
    with pytest.raises(SettingError, match=r"faces: found .*; expected indices 0 to 19"):
        TangentGrid(0, 4).directions(faces)


@pytest.mark.parametrize(("base_level", "level"), [(-1, 4), (5, 4)])
def test_impossible_levels_are_refused(base_level: int, level: int) -> None:
    with pytest.raises(SettingError, match=f"base_level: found {base_level}; expected 0 to level"):
        TangentGrid(base_level, level)


@pytest.mark.parametrize(
    "rotation",
    [
        np.eye(2),
        2 * np.eye(3),
        np.diag([1.0, 1, -1]),  # a reflection
        np.full((3, 3), np.nan),
        TURN + 1e-3,
    ],
)
def test_impossible_rotations_are_refused(rotation: NDArray[np.float64]) -> None:
    with pytest.raises(SettingError, match=r"rotation: found .* of determinant"):
        TangentGrid(0, 4, rotation=rotation)


def test_grids_are_values() -> None:
    different = [
        TangentGrid(0, 5),
        TangentGrid(1, 5),
        TangentGrid(0, 6),
        TangentGrid(0, 5, 30),
        TangentGrid(0, 5, rotation=TURN),
        TangentGrid(0, 5, rotation=TURN.T),
    ]
    assert len(set(different)) == len(different)
    assert TangentGrid(0, 5) == TangentGrid(0, 5, 32)
    assert hash(TangentGrid(0, 5)) == hash(TangentGrid(0, 5, 32))
    assert len({hash(TangentGrid(0, level)) for level in range(5, 10)}) == 5
    assert TangentGrid(0, 5, rotation=TURN) == TangentGrid(0, 5, rotation=TURN.tolist())
    assert TangentGrid(0, 5) != (0, 5, 32, None)


def test_grids_cannot_change() -> None:
    rotation = TURN.copy()
    grid = TangentGrid(0, 4, rotation=rotation)
    rotation[:] = np.eye(3)
    np.testing.assert_array_equal(grid.rotation, TURN)
    with pytest.raises(FrozenInstanceError):
        grid.dim = 3  # type: ignore[misc]
    for array in (grid.rotation, grid.world_from_camera, grid.centers_xyz):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 5  # type: ignore[index]
