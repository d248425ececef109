from __future__ import annotations

import numpy as np
import pytest
import torch

from datamodules.core.dataset import Image
from tangent_train.geometry.sphere import area_mask
from tangent_train.heads.pictures import (
    mixed_picture,
    prediction_panel,
    shown_arrays,
)
from tangent_train.io.palette import class_colors

NAMES = ("unknown", "wall", "floor", "sofa")


def test_an_overlay_keeps_the_hues_of_the_classes() -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (6, 8, 3), np.uint8)
    labels = np.ones((6, 8), np.uint8)
    labels[2:, 3:] = 2
    labels[5] = 0
    mixed = mixed_picture(rgb, labels, 3).astype(float)
    colors = class_colors(3)[labels].astype(float)
    light = 2 * mixed - colors  # gray, but for rounding
    inside = labels > 0
    inside[2, 3:] = inside[2:5, 3] = False
    assert np.ptp(light[inside], axis=-1).max() <= 2
    weights = [0.299, 0.587, 0.114]  # luma of ITU-R BT.601
    np.testing.assert_allclose(light[inside].mean(axis=-1), rgb[inside] @ weights, atol=2)
    np.testing.assert_array_equal(mixed[2, 3:], colors[2, 3:], "where a class begins")
    np.testing.assert_array_equal(mixed[2:5, 3], colors[2:5, 3])
    np.testing.assert_array_equal(mixed[5], rgb[5], "unknown")


@pytest.mark.parametrize(("rows", "scale"), [(100, 2), (256, 1), (300, 1)])
def test_the_panel_shows_input_truth_prediction_and_error(rows: int, scale: int) -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (rows, 2 * rows, 3), np.uint8)
    truth = rng.integers(0, 3, (rows, 2 * rows))
    prediction = np.where(truth == 0, 1, truth)
    prediction[:, :10] = 3
    panel = prediction_panel(rgb, truth, prediction, NAMES)
    height, width = scale * rows, scale * 2 * rows
    top, left = slice(22, 22 + height, scale), slice(0, width, scale)
    bottom = slice(44 + height, 44 + 2 * height, scale)
    right = slice(width + 8, 2 * width + 8, scale)
    np.testing.assert_array_equal(panel[top, left], rgb)
    np.testing.assert_array_equal(panel[top, right], class_colors(4)[truth])
    np.testing.assert_array_equal(panel[bottom, left], class_colors(4)[prediction])
    error = panel[bottom, right]
    assert np.all(error[(truth == 0)] == 160)
    assert np.all(error[(truth != 0) & (prediction == truth)] == 255)
    assert np.all(error[(truth != 0) & (prediction != truth)] == (214, 39, 40))
    assert panel.shape[0] > 44 + 2 * height, "a legend follows"


def test_a_partial_panorama_is_shown_cut_or_black_around() -> None:
    valid = area_mask((90, -90, -45, 22.5), (32, 64))
    rng = np.random.default_rng(0)
    image = Image(
        rng.integers(1, 256, (32, 64, 3), np.uint8), None, np.ones((32, 64), np.uint8), valid=valid
    )
    labels = torch.ones(32, 64, dtype=torch.uint8)
    for found in shown_arrays(image, labels, labels, None, cut=False):
        assert (found[valid] > 0).all()
        assert (found[~valid] == 0).all()
    rgb, truth, _ = shown_arrays(image, labels, labels, None)
    assert truth.shape == (12, 32)
    np.testing.assert_array_equal(rgb, image.rgb[12:24][:, np.r_[48:64, 0:16]])
