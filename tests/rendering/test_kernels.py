"""Compiled loops: rows, tiles and their edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tangent_train.geometry import TangentGrid, equirect_directions, lonlat_to_equirect
from tangent_train.geometry.sphere import xyz_to_lonlat
from tangent_train.rendering import feather_kernels, kernels, label_kernels
from tangent_train.rendering.tables import feather_arguments, owner_arguments


def test_directions_of_rows_are_the_panoramas() -> None:
    columns, rows = kernels.directions_of_rows(7, 12)
    directions = equirect_directions((7, 12))
    np.testing.assert_allclose(rows[:, None, :1] * columns[None], directions[..., :2], atol=1e-15)
    np.testing.assert_allclose(rows[:, 1], directions[:, 0, 2], atol=1e-15)


def test_pinhole_map_writes_only_its_rows() -> None:
    grid = TangentGrid(0, 4)
    world_from_pixel = grid.world_from_camera[4] @ np.linalg.inv(grid.camera_matrix)
    u, v = np.full((2, 16, 16), -9.0)
    kernels.pinhole_map(3, 5, world_from_pixel[None], 20, 40, u, v)
    expected = lonlat_to_equirect(xyz_to_lonlat(grid.directions([4])[0]), (20, 40))
    np.testing.assert_allclose(np.stack([u, v], axis=-1)[3:5], expected[3:5], atol=1e-12)
    assert (u[:3] == -9).all()
    assert (v[5:] == -9).all()


@pytest.mark.parametrize("rows", [(0, 1), (5, 41)])
def test_label_rows_need_not_fill_tiles(rows: tuple[int, int]) -> None:
    grid, shape = TangentGrid(0, 4), (41, 83)
    scores = np.random.default_rng(0).random((20, 4, 16, 16), np.float32)
    calls: list[tuple[Any, tuple[Any, ...]]] = [
        (label_kernels.owner_labels, owner_arguments(grid, shape)),
        (feather_kernels.feather_labels, feather_arguments(grid, shape)),
    ]
    for kernel, arguments in calls:
        whole, part = np.full((2, *shape), 9, np.uint8)
        kernel(0, shape[0], scores, *arguments, whole)
        kernel(*rows, scores, *arguments, part)
        np.testing.assert_array_equal(part[slice(*rows)], whole[slice(*rows)])
        assert (np.delete(part, np.s_[slice(*rows)], axis=0) == 9).all()
        assert whole.max() < 4
