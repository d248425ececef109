from __future__ import annotations

import numpy as np
import pytest
import torch
from torchmetrics.classification import MulticlassAccuracy

from tangent_train.metrics.classification import ClassificationMetric, classification_scores

CLASSES = 6


def test_scores_equal_torchmetrics_over_the_whole_data_set() -> None:
    generator = torch.Generator().manual_seed(1)
    prediction = torch.randint(0, CLASSES, (38,), generator=generator)
    truth = torch.randint(0, CLASSES - 2, (38,), generator=generator)  # without the last class
    truth[20] = prediction[20] = CLASSES - 2  # a class of a single image
    metric = ClassificationMetric(CLASSES)
    for batch in (slice(7), slice(7, 8), slice(8, None)):
        metric.update(prediction[batch], truth[batch])
    matrix = metric.compute()
    for cell in np.ndindex(CLASSES, CLASSES):
        assert matrix[cell] == ((truth == cell[0]) & (prediction == cell[1])).sum()
    scores = classification_scores(matrix)
    overall = MulticlassAccuracy(CLASSES, average="micro")(prediction, truth)
    assert scores.accuracy == pytest.approx(float(overall))
    of_class = MulticlassAccuracy(CLASSES, average="none")(prediction, truth).numpy()
    np.testing.assert_allclose(scores.of_class[:-1], of_class[:-1], rtol=1e-6)
    assert np.isnan(scores.of_class[-1]), "it does not occur, and is left out of the mean"
    assert scores.class_accuracy == pytest.approx(float(of_class[:-1].mean()))
    assert scores.counts.sum() == 38


def test_counts_are_whole_numbers_summed_over_processes() -> None:
    metric = ClassificationMetric(2)
    metric.confmat += 2**24  # float32 cannot count beyond
    metric.update(torch.tensor([1]), torch.tensor([0]))

    def gather(state: torch.Tensor, group: object = None) -> list[torch.Tensor]:
        return [state, 2 * state]

    metric.dist_sync_fn, metric.distributed_available_fn = gather, lambda: True
    expected = 2**24 + np.array([[0, 1], [0, 0]])
    np.testing.assert_array_equal(metric.compute(), 3 * expected)
