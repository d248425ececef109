"""Sizes and unknown pixels of images, against slow references."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from datamodules.core.depth import resize_depth
from datamodules.core.image_module import Unknown, mask_black
from tangent_train.rendering.resampling import crop, resize
from tests.datamodules.data_files import nearest_valid


def test_a_ramp_keeps_its_place_at_an_uneven_ratio() -> None:
    # The center of target column j lies at (j + ½) · 3/2 source columns; the ramp shows it.
    ramp = np.tile(np.arange(96, dtype=np.uint8) * 2, (48, 1))
    expected = 2 * ((np.arange(64) + 0.5) * 1.5 - 0.5)
    area = resize(np.repeat(ramp[..., None], 3, axis=2), (32, 64), "bilinear")[0, :, 0]
    np.testing.assert_allclose(area, expected, atol=1)
    np.testing.assert_allclose(resize(ramp, (32, 64), "nearest")[0], expected, atol=1)
    depth = resize_depth(ramp.astype(np.uint16) + 1, (32, 64))[0].astype(int) - 1
    np.testing.assert_allclose(depth, expected, atol=1)


def test_colors_are_means_of_areas() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (32, 64, 3), np.uint8)
    means = rgb.reshape(8, 4, 16, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(resize(rgb, (8, 16), "bilinear"), means, atol=0.501)


@pytest.mark.parametrize("shape", [(8, 16), (12, 24), (48, 96)])
def test_resized_tensors_are_those_of_opencv(shape: tuple[int, int]) -> None:
    rgb = np.random.default_rng(2).random((32, 64, 3), np.float32)
    expected = resize(rgb, shape, "bilinear")
    found = resize(torch.from_numpy(rgb).permute(2, 0, 1), shape, "bilinear")
    np.testing.assert_allclose(found.permute(1, 2, 0), expected, atol=1e-5)


@pytest.mark.parametrize("shape", [(7, 9), (40, 60)])
def test_crops_of_tensors_are_those_of_pillow(shape: tuple[int, int]) -> None:
    """Smaller and larger than the part of the photo that they show."""
    rgb = np.random.default_rng(1).integers(0, 256, (20, 30, 3), np.uint8)
    box = np.array([3.0, 2.5, 18.2, 13.0])
    expected = crop(rgb, box, shape, "bilinear")
    found = crop(torch.from_numpy(rgb).permute(2, 0, 1).float(), box, shape, "bilinear")
    np.testing.assert_allclose(found.permute(1, 2, 0), expected, atol=1.01)


@pytest.mark.parametrize("shape", [(12, 24), (4, 8), (3, 6), (5, 10)])
def test_depth_is_that_of_the_nearest_valid_pixel(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    depth = rng.integers(1, 2000, (12, 24), np.uint16)
    depth[rng.random(depth.shape) < 0.7] = 0
    small = resize_depth(depth, shape)
    assert small.dtype == np.uint16
    np.testing.assert_array_equal(small, nearest_valid(depth, shape))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    ("unknown", "expected"),
    [("labels", [5, 5, 5]), ("any_black", [0, 0, 5]), ("all_black", [0, 5, 5])],
)
def test_black_pixels_are_unknown(unknown: Unknown, expected: list[int], dtype: type) -> None:
    rgb = np.array([[[0, 0, 0], [9, 0, 9], [1, 2, 3]]], np.uint8)
    masked = mask_black(np.full((1, 3), 5, dtype), rgb, unknown)
    assert masked.dtype == dtype
    assert masked.tolist() == [expected]
