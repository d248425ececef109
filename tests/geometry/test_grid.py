"""Tangent images: textbook gnomonic formulas, rotations, errors."""

from __future__ import annotations

import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import CubeGrid, TangentGrid, rotation_about
from tests.rendering.reference import ReferenceGrid, to_xyz

ROTATION = rotation_about((1, 2, -3), 1.1)


@pytest.mark.parametrize(("base_level", "level", "dim"), [(0, 5, None), (1, 5, 13), (2, 5, 20)])
def test_directions_follow_the_textbook_formulas(
    base_level: int, level: int, dim: int | None
) -> None:
    grid = TangentGrid(base_level, level, dim)
    reference = ReferenceGrid(base_level, level, grid.dim)
    expected = [to_xyz(reference.lonlat(face)) for face in reference.order(grid.centers_xyz)]
    np.testing.assert_allclose(grid.directions(), expected, atol=1e-13)


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


@pytest.mark.parametrize(("base_level", "level"), [(-1, 4), (5, 4)])
def test_impossible_levels_are_refused(base_level: int, level: int) -> None:
    with pytest.raises(SettingError, match=f"base_level: found {base_level}; expected 0 to level"):
        TangentGrid(base_level, level)


def test_grids_are_values() -> None:
    different = [
        TangentGrid(0, 5),
        TangentGrid(1, 5),
        TangentGrid(0, 6),
        TangentGrid(0, 5, 30),
        TangentGrid(0, 5, rotation=ROTATION),
        TangentGrid(0, 5, rotation=ROTATION.T),
        CubeGrid(32),
        CubeGrid(33),
        CubeGrid(32, ROTATION),
        CubeGrid(32, margin=1),
    ]
    assert len(set(different)) == len({hash(grid) for grid in different}) == len(different)
    for grid in different:
        again = pickle.loads(pickle.dumps(grid))
        assert (again, hash(again)) == (grid, hash(grid))
    assert TangentGrid(0, 5) == TangentGrid(0, 5, 32)
    assert CubeGrid(32, ROTATION) == CubeGrid(32, ROTATION.tolist())
    assert CubeGrid(32) != (32, None)


def test_grids_cannot_change() -> None:
    rotation = ROTATION.copy()
    grid = TangentGrid(0, 4, rotation=rotation)
    rotation[:] = np.eye(3)
    np.testing.assert_array_equal(grid.rotation, ROTATION)
    with pytest.raises(FrozenInstanceError):
        grid.dim = 3  # type: ignore[misc]
    for array in (grid.rotation, grid.world_from_camera, grid.centers_xyz):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 5  # type: ignore[index]
