"""Pinhole views and turned panoramas."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    FLIP_Y,
    TangentGrid,
    equirect_directions,
    lonlat_to_equirect,
    perspective_directions,
    random_rotation,
    rotation_about,
    xyz_to_lonlat,
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


@pytest.mark.parametrize("columns", [1, 16, 31])
def test_a_turn_about_the_vertical_shifts_columns(columns: int) -> None:
    image = np.random.default_rng(0).integers(0, 255, (16, 32, 3), np.uint8)
    turn = rotation_about([0, 0, 1], columns / 32 * 2 * np.pi)
    for interpolation in ("bilinear", "nearest"):
        turned = rotate_equirect(image, turn, interpolation)
        np.testing.assert_array_equal(turned, np.roll(image, columns, axis=1))


def _sources(directions_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns and rows of a panorama of 24×48 that directions look at."""
    return lonlat_to_equirect(xyz_to_lonlat(directions_xyz), (24, 48))


def _views(
    image: NDArray[Any], interpolation: Any
) -> list[tuple[NDArray[Any], NDArray[np.float64]]]:
    """A turned panorama and a pinhole view, and where each pixel comes from."""
    turn = random_rotation(np.random.default_rng(3))
    matrix = np.array([[9.0, 0, 5], [0, 8, 4], [0, 0, 1]])
    axes = FLIP_Y @ random_rotation(np.random.default_rng(4))
    return [
        (
            rotate_equirect(image, turn, interpolation),
            _sources(equirect_directions((24, 48)) @ turn),
        ),
        (
            equirect_to_perspective(image, matrix, (10, 14), axes, interpolation),
            _sources(perspective_directions(matrix, (10, 14)) @ axes.T),
        ),
    ]


def test_labels_come_from_the_nearest_pixel() -> None:
    labels = np.random.default_rng(0).choice(np.array([0, 3, 255], np.uint8), (24, 48))
    for found, sources in _views(labels, "nearest"):
        columns, rows = np.moveaxis(np.rint(sources).astype(int), -1, 0)
        expected = labels[rows.clip(0, 23), columns % 48]
        clear = (np.abs(sources % 1 - 0.5) > 0.01).all(axis=-1)  # of ties and rounding
        assert clear.mean() > 0.9
        np.testing.assert_array_equal(found[clear], expected[clear])


def test_float64_is_sampled_to_rounding() -> None:
    image = np.arange(24.0)[:, None].repeat(48, axis=1)
    for found, sources in _views(image, "bilinear"):
        np.testing.assert_allclose(found, sources[..., 1].clip(0, 23), atol=1e-11)


@pytest.mark.parametrize("rotation", [np.eye(2), 2 * np.eye(3), np.diag([1.0, -1, 1])])
def test_errors(rotation: NDArray[np.float64]) -> None:
    with pytest.raises(SettingError, match="rotation"):
        rotate_equirect(np.zeros((4, 8)), rotation)
