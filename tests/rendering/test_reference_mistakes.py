"""Mistakes of the released code and of rivals that concern rendering: none of them here."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import TangentGrid, equirect_shape, xyz_to_lonlat
from tangent_train.rendering import (
    equirect_to_tangent,
)

CLASSES = 13
Labels = NDArray[np.uint8]


@pytest.mark.parametrize("base_level", [0, 1])
def test_1_labels_at_the_seam_are_never_unknown(base_level: int) -> None:
    level = base_level + 4
    grid = TangentGrid(base_level, level)
    height, width = equirect_shape(level)
    labels = np.full((height, width), 3, np.uint8)  # 0 would be unknown
    labels[:, 0], labels[:, -1] = 1, 2
    images = equirect_to_tangent(labels, grid, interpolation="nearest")
    assert images.min() > 0
    # The seam runs through images, its first column to the right of its last.
    lon = xyz_to_lonlat(grid.directions())[..., 0]
    step = 2 * np.pi / width
    np.testing.assert_array_equal(images == 1, lon < -np.pi + step)
    np.testing.assert_array_equal(images == 2, lon >= np.pi - step)
    assert (images == 1).any(axis=(1, 2)).sum() >= 4
