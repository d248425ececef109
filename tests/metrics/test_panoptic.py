"""Panoptic quality: against torchmetrics, and in cases whose answer is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchmetrics.detection import PanopticQuality

from tangent_train.metrics.panoptic import LABEL, panoptic_sums, quality

SHAPE = (64, 128)
THINGS, STUFF = (3, 4, 5), (1, 2)


def random_map(seed: int) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    codes = np.full(SHAPE, LABEL)
    for number in range(1, 25):
        (y, x), (h, w) = rng.integers(0, SHAPE), rng.integers(5, 30, 2)
        label = int(rng.integers(1, 6))
        codes[y : y + h, x : x + w] = label * LABEL + number * (label in THINGS)
    return codes


def test_values_of_torchmetrics() -> None:
    truth = random_map(1)
    prediction = np.roll(truth, 2, axis=1)
    prediction[:20] = random_map(2)[:20]
    metric = PanopticQuality(set(THINGS), set(STUFF), return_sq_and_rq=True, return_per_class=True)
    pairs = (np.stack([codes // LABEL, codes % LABEL], -1) for codes in (prediction, truth))
    metric.update(*(torch.from_numpy(codes)[None] for codes in pairs))
    expected = metric.compute().numpy()[[3, 4, 0, 1, 2]]  # things first
    found = quality(panoptic_sums(prediction, truth, 6)[0, 0])
    assert np.stack([found["pq"], found["sq"], found["rq"]], -1) == pytest.approx(expected)


def test_unknown_truth_does_not_count() -> None:
    truth = np.full(SHAPE, LABEL)
    truth[:, :40] = 0
    prediction = np.full(SHAPE, LABEL)
    prediction[:, :30] = 2 * LABEL + 1  # wholly unknown
    prediction[10:20, 36:46] = 2 * LABEL + 2  # 6 of 10 columns are known
    ((_, wrong),) = [panoptic_sums(prediction, truth, 3)[0, 0, :, 3]]
    assert wrong == 1
    assert panoptic_sums(truth, truth, 3)[0, 0].tolist() == [[1, 1, 0, 0], [0, 0, 0, 0]]


def test_solid_angle_and_subsets() -> None:
    """A band at the pole with 3 of 4 rows found: ¾ of the pixels, more of the solid angle."""
    truth = np.full(SHAPE, LABEL)
    truth[:4] = 2 * LABEL + 1
    truth[30:34, :5] = truth[30:34, -5:] = 2 * LABEL + 2
    prediction: Any = truth.copy()
    prediction[0] = LABEL
    sums = panoptic_sums(prediction, truth, 3)
    edges = np.cos(np.radians(180 / 64 * np.array([1, 4])))
    cap = (edges[0] - edges[1]) / (1 - edges[1])
    assert sums[0, :, 1].tolist() == [[1.75, 2, 0, 0], [1.75, 2, 0, 0], [0.75, 1, 0, 0]]
    assert sums[1, 2, 1] == pytest.approx([cap, 1, 0, 0])
    prediction[:4] = LABEL
    assert panoptic_sums(prediction, truth, 3)[1, 2, 1].tolist() == [0, 0, 1, 0]
