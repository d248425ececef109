from __future__ import annotations

import numpy as np
import pytest
import torch
from torchmetrics.classification import MulticlassAccuracy, MulticlassConfusionMatrix

from tangent_train.errors import SettingError
from tangent_train.metrics.classification import ClassCounts, classification_scores

CLASSES = 6


def _batches() -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Prediction and truth of uneven batches, without the last class."""
    generator = torch.Generator().manual_seed(1)
    return [
        (
            torch.randint(0, CLASSES, (count,), generator=generator),
            torch.randint(0, CLASSES - 1, (count,), generator=generator),
        )
        for count in (7, 1, 30)
    ]


def _counted(batches: list[tuple[torch.Tensor, torch.Tensor]]) -> ClassCounts:
    metric = ClassCounts(CLASSES)
    for prediction, truth in batches:
        metric.update(prediction, truth)
    return metric


def test_scores_equal_torchmetrics_over_the_whole_data_set() -> None:
    matrix = _counted(_batches()).compute()
    prediction, truth = (torch.cat(parts) for parts in zip(*_batches(), strict=True))
    reference = MulticlassConfusionMatrix(CLASSES)(prediction, truth)
    np.testing.assert_array_equal(matrix, reference.numpy())
    scores = classification_scores(matrix)
    overall = MulticlassAccuracy(CLASSES, average="micro")(prediction, truth)
    assert scores.accuracy == pytest.approx(float(overall))
    of_class = MulticlassAccuracy(CLASSES, average="none")(prediction, truth).numpy()
    np.testing.assert_allclose(scores.of_class[:-1], of_class[:-1], rtol=1e-6)
    assert scores.class_accuracy == pytest.approx(float(of_class[:-1].mean()))
    assert scores.counts.sum() == 38


def test_classes_that_do_not_occur_are_left_out_of_the_mean() -> None:
    scores = classification_scores([[3, 1, 0], [0, 0, 0], [0, 2, 0]])
    assert scores.accuracy == pytest.approx(3 / 6)
    assert scores.class_accuracy == pytest.approx((3 / 4 + 0) / 2)
    assert np.isnan(scores.of_class).tolist() == [False, True, False]


def test_nothing_counted_has_no_scores() -> None:
    scores = classification_scores(np.zeros((3, 3), np.int64))
    assert np.isnan([scores.accuracy, scores.class_accuracy, *scores.of_class]).all()
    assert scores.counts.tolist() == [0, 0, 0]


def test_a_class_of_one_counts_like_all_others() -> None:
    scores = classification_scores(np.array([[1.0, 0, 0], [1, 2, 1], [0, 0, 0]]))
    assert scores.of_class[:2].tolist() == [1, 0.5]
    assert scores.class_accuracy == 0.75
    assert scores.counts.dtype == np.int64


def test_counts_are_whole_numbers_summed_over_processes() -> None:
    metric = ClassCounts(2)
    metric.confusion += 2**24  # float32 cannot count beyond
    metric.update(torch.tensor([1]), torch.tensor([0]))
    expected = 2**24 + np.array([[0, 1], [0, 0]])

    def gather(state: torch.Tensor, group: object = None) -> list[torch.Tensor]:
        return [state, 2 * state]

    metric.dist_sync_fn, metric.distributed_available_fn = gather, lambda: True
    np.testing.assert_array_equal(metric.compute(), 3 * expected)


def test_matrices_add_up_over_processes_and_reset() -> None:
    batches = _batches()
    parts = [_counted(batches[:1]), _counted(batches[1:])]
    whole = _counted(batches)
    np.testing.assert_array_equal(whole.compute(), sum(part.compute() for part in parts))
    whole.reset()
    assert not whole.confusion.any()
    assert _counted([(torch.zeros(0, dtype=torch.int64),) * 2]).compute().sum() == 0


@pytest.mark.parametrize(
    ("prediction", "truth", "message"),
    [
        ([0, 1], [0], "prediction: found"),
        ([CLASSES], [0], "class index: found 6 to 6; expected 0 to 5"),
        ([0, 1], [-1, 2], "class index: found -1 to 2"),
    ],
)
def test_bad_input_is_refused(prediction: list[int], truth: list[int], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        ClassCounts(CLASSES).update(torch.tensor(prediction), torch.tensor(truth))
