from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from datamodules.core.images import mask_black, resize_area, resize_depth, resize_nearest
from tests.datamodules.data_files import nearest_valid

# --- sizes -------------------------------------------------------------------------------------


def test_a_ramp_keeps_its_place_at_an_uneven_ratio() -> None:
    # The center of target column j lies at (j + ½) · 3/2 source columns; the ramp shows it.
    ramp = np.tile(np.arange(96, dtype=np.uint8) * 2, (48, 1))
    expected = 2 * ((np.arange(64) + 0.5) * 1.5 - 0.5)
    area = resize_area(np.repeat(ramp[..., None], 3, axis=2), (32, 64))[0, :, 0]
    np.testing.assert_allclose(area, expected, atol=1)
    np.testing.assert_allclose(resize_nearest(ramp, (32, 64))[0], expected, atol=1)


def test_colors_are_means_of_areas() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)
    means = rgb.reshape(8, 4, 16, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(resize_area(rgb, (8, 16)), means, atol=0.501)


@pytest.mark.parametrize("shape", [(12, 24), (4, 8), (3, 6), (5, 10)])
def test_depth_is_that_of_the_nearest_valid_pixel(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    depth = rng.integers(1, 2000, (12, 24), np.uint16)
    depth[rng.random(depth.shape) < 0.7] = 0
    small, reference = resize_depth(depth, shape), nearest_valid(depth, shape)
    assert small.dtype == np.uint16
    np.testing.assert_array_equal(small, reference)


# --- masks -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mask", "expected"),
    [("labels", [5, 5, 5]), ("any_black", [0, 0, 5]), ("all_black", [0, 5, 5])],
)
def test_black_pixels_are_unknown(
    mask: Literal["labels", "any_black", "all_black"], expected: list[int]
) -> None:
    rgb = np.array([[[0, 0, 0], [9, 0, 9], [1, 2, 3]]], np.uint8)
    masked = mask_black(np.full((1, 3), 5, np.uint8), rgb, mask)
    assert masked.dtype == np.uint8
    assert masked.tolist() == [expected]
