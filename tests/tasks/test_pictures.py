from __future__ import annotations

import numpy as np
import pytest

from tangent_train.tasks.pictures import class_colors, colorize, prediction_panel

NAMES = ("unknown", "wall", "floor", "sofa")


@pytest.mark.parametrize("count", [2, 14, 21])
def test_colours_are_distinct_and_unknown_is_black(count: int) -> None:
    colors = class_colors(count).astype(int)
    assert colors[0].tolist() == [0, 0, 0]
    distances = np.abs(colors[:, None] - colors[None]).sum(axis=-1) + 999 * np.eye(count, dtype=int)
    assert distances.min() > 15


def test_the_panel_shows_input_truth_prediction_and_error() -> None:
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (40, 80, 3), np.uint8)
    truth = rng.integers(0, 3, (40, 80))
    prediction = np.where(truth == 0, 1, truth)
    prediction[:, :10] = 3
    panel = prediction_panel(rgb, truth, prediction, NAMES)
    top, bottom, left, right = slice(22, 62), slice(84, 124), slice(0, 80), slice(88, 168)
    np.testing.assert_array_equal(panel[top, left], rgb)
    np.testing.assert_array_equal(panel[top, right], colorize(truth, 4))
    np.testing.assert_array_equal(panel[bottom, left], colorize(prediction, 4))
    error = panel[bottom, right]
    assert np.all(error[(truth == 0)] == 160)
    assert np.all(error[(truth != 0) & (prediction == truth)] == 255)
    assert np.all(error[(truth != 0) & (prediction != truth)] == (214, 39, 40))
    assert panel.shape[0] > 124, "a legend follows"
