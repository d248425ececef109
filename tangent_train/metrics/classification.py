"""One confusion matrix of whole images over the data set, and the scores read from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Integer
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torchmetrics import Metric

from tangent_train.errors import SettingError

__all__ = ["ClassCounts", "ClassificationScores", "classification_scores"]


class ClassificationScores(NamedTuple):
    """Scores of one confusion matrix.

    Attributes:
        accuracy: Share of all that was classified rightly.
        class_accuracy: Mean of `of_class`, so that every class counts the same.
        of_class: ``(K,)`` share of a class that was classified rightly; NaN for classes that do not
            occur, which are left out of the mean.
        counts: ``(K,)`` how many a class has.
    """

    accuracy: float
    class_accuracy: float
    of_class: NDArray[np.float64]
    counts: NDArray[np.int64]


def classification_scores(confusion: ArrayLike) -> ClassificationScores:
    """Scores of a whole data set.

    Args:
        confusion: ``(K, K)`` counts, rows truth, columns prediction.

    Returns:
        The scores; NaN where nothing was counted.
    """
    matrix = np.asarray(confusion, np.int64)
    counts, hits = matrix.sum(axis=1), matrix.diagonal()
    present = counts > 0
    of_class = np.full(len(counts), np.nan)
    of_class[present] = hits[present] / counts[present]
    if not present.any():
        return ClassificationScores(np.nan, np.nan, of_class, counts)
    accuracy = float(hits.sum() / counts.sum())
    return ClassificationScores(accuracy, float(of_class[present].mean()), of_class, counts)


class ClassCounts(Metric):
    """The confusion matrix of whole images, integer counts summed over processes.

    Args:
        num_classes: K.

    Attributes:
        confusion: ``(K, K)``, rows truth, columns prediction.
    """

    full_state_update = False
    confusion: Tensor

    def __init__(self, num_classes: int) -> None:
        super().__init__()
        self.num_classes = num_classes
        square = torch.zeros((num_classes, num_classes), dtype=torch.int64)
        self.add_state("confusion", square, dist_reduce_fx="sum")

    def update(
        self, prediction: Integer[Tensor, " images"], truth: Integer[Tensor, " images"]
    ) -> None:
        """Count some images.

        Args:
            prediction: Class indices.
            truth: Class indices.

        Raises:
            SettingError: The shapes differ or an index is out of range.
        """
        if prediction.shape != truth.shape:
            raise SettingError(
                "prediction", found=tuple(prediction.shape), expected=tuple(truth.shape)
            )
        k = self.num_classes
        for indices in (prediction, truth):
            if indices.numel() and not 0 <= int(indices.min()) <= int(indices.max()) < k:
                raise SettingError(
                    "class index",
                    found=f"{int(indices.min())} to {int(indices.max())}",
                    expected=f"0 to {k - 1}",
                )
        pairs = truth.long() * k + prediction.long()
        self.confusion += torch.bincount(pairs, minlength=k * k).reshape(k, k)

    def compute(self) -> NDArray[np.int64]:
        """The matrix of all processes."""
        counts: NDArray[np.int64] = self.confusion.cpu().numpy()
        return counts
