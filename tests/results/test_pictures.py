from __future__ import annotations

import numpy as np
import pytest

from datamodules.images.palette import class_colors
from tangent_train.results.pictures import colorize, prediction_panel

NAMES = ("unknown", "wall", "floor", "sofa")


@pytest.mark.parametrize("count", [2, 14, 21])
def test_colours_are_distinct_and_unknown_is_black(count: int) -> None:
    colors = class_colors(count).astype(int)
    assert colors[0].tolist() == [0, 0, 0]
    distances = np.abs(colors[:, None] - colors[None]).sum(axis=-1) + 999 * np.eye(count, dtype=int)
    assert distances.min() > 15


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
    np.testing.assert_array_equal(panel[top, right], colorize(truth, 4))
    np.testing.assert_array_equal(panel[bottom, left], colorize(prediction, 4))
    error = panel[bottom, right]
    assert np.all(error[(truth == 0)] == 160)
    assert np.all(error[(truth != 0) & (prediction == truth)] == 255)
    assert np.all(error[(truth != 0) & (prediction != truth)] == (214, 39, 40))
    assert panel.shape[0] > 44 + 2 * height, "a legend follows"
