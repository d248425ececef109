"""Pinhole views and turned panoramas."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    TangentGrid,
    equirect_directions,
    random_rotation,
    rotation_about,
)
from tangent_train.rendering import (
    equirect_to_perspective,
    equirect_to_tangent,
    rotate_equirect,
)


def test_a_tangent_image_is_a_perspective_view() -> None:
    image = np.random.default_rng(0).random((64, 128, 3), np.float32)
    grid = TangentGrid(1, 6)
    view = equirect_to_perspective(
        image, grid.camera_matrix, (grid.dim, grid.dim), grid.world_from_camera[13]
    )
    np.testing.assert_array_equal(view, equirect_to_tangent(image, grid, [13])[0])


def test_perspective_views_may_be_oblong() -> None:
    image = np.arange(32, dtype=np.uint8)[:, None].repeat(64, axis=1)  # the row number
    world_from_camera = np.array([[0, 0, 1.0], [1, 0, 0], [0, -1, 0]])
    matrix = np.array([[20.0, 0, 2], [0, 20, 1], [0, 0, 1]])
    view = equirect_to_perspective(image, matrix, (3, 5), world_from_camera, "nearest")
    assert view.shape == (3, 5)
    np.testing.assert_array_equal(view[[0, 2], 2], [15, 16])


@pytest.mark.parametrize("columns", [1, 16, 31])
def test_a_turn_about_the_vertical_shifts_columns(columns: int) -> None:
    image = np.random.default_rng(0).integers(0, 255, (16, 32, 3), np.uint8)
    turn = rotation_about([0, 0, 1], columns / 32 * 2 * np.pi)
    for interpolation in ("bilinear", "nearest"):
        turned = rotate_equirect(image, turn, interpolation)
        np.testing.assert_array_equal(turned, np.roll(image, columns, axis=1))


def test_half_a_turn_about_a_level_axis_turns_upside_down() -> None:
    image = np.random.default_rng(0).random((15, 31))
    turned = rotate_equirect(image, rotation_about([1, 0, 0], np.pi))
    np.testing.assert_allclose(turned, image[::-1, ::-1], atol=1e-9)


def test_turning_the_panorama_and_the_grid_cancel() -> None:
    x, y, z = np.moveaxis(equirect_directions((128, 256)), -1, 0)
    image = np.stack([x * y + z, y - z * x], axis=-1)
    turn = random_rotation(np.random.default_rng(3))
    expected = equirect_to_tangent(image, TangentGrid(0, 5))
    turned = equirect_to_tangent(rotate_equirect(image, turn), TangentGrid(0, 5, rotation=turn))
    np.testing.assert_allclose(turned, expected, atol=2e-3)


@pytest.mark.parametrize("rotation", [np.eye(2), 2 * np.eye(3), np.diag([1.0, -1, 1])])
def test_errors(rotation: NDArray[np.float64]) -> None:
    with pytest.raises(SettingError, match="rotation"):
        rotate_equirect(np.zeros((4, 8)), rotation)
