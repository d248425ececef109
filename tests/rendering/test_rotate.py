"""Rotated panoramas."""

from __future__ import annotations

import numpy as np
import pytest

from tangent_train.errors import SettingError
from tangent_train.geometry import rotation_about
from tangent_train.rendering import rotate_equirect


@pytest.mark.parametrize("columns", [1, 16, 31])
def test_a_rotation_about_the_vertical_shifts_columns(columns: int) -> None:
    image = np.random.default_rng(0).integers(0, 255, (16, 32, 3), np.uint8)
    turn = rotation_about([0, 0, 1], columns / 32 * 2 * np.pi)
    for interpolation in ("bilinear", "nearest"):
        rotated = rotate_equirect(image, turn, interpolation)
        np.testing.assert_array_equal(rotated, np.roll(image, columns, axis=1))


def test_errors() -> None:
    with pytest.raises(SettingError, match="rotation"):
        rotate_equirect(np.zeros((4, 8)), np.diag([1.0, -1, 1]))
