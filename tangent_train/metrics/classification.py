"""One confusion matrix of whole images over the data set, and the scores read from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torchmetrics.classification import MulticlassConfusionMatrix


class ClassificationScores(NamedTuple):
    """Scores of one confusion matrix.

    Attributes:
        accuracy: Share of all images that was classified correctly.
        class_accuracy: Mean of `of_class`, so that every class counts the same.
        of_class: ``(K,)`` share of a class that was classified correctly; NaN for classes that do
            not occur, which are left out of the mean.
        counts: ``(K,)`` images of each class.
    """

    accuracy: float
    class_accuracy: float
    of_class: NDArray[np.float64]
    counts: NDArray[np.int64]


def classification_scores(confusion: ArrayLike) -> ClassificationScores:
    """Compute the scores of a whole data set.

    Args:
        confusion: ``(K, K)`` counts, rows truth, columns prediction.

    Returns:
        The scores; NaN where nothing was counted.
    """
    matrix = np.asarray(confusion, np.int64)
    counts, hits = matrix.sum(axis=1), matrix.diagonal()
    present = counts > 0
    of_class = np.full(len(counts), np.nan)
    np.divide(hits, counts, out=of_class, where=present)
    if not present.any():
        return ClassificationScores(np.nan, np.nan, of_class, counts)
    accuracy = float(hits.sum() / counts.sum())
    return ClassificationScores(accuracy, float(of_class[present].mean()), of_class, counts)


class ClassificationMetric(MulticlassConfusionMatrix):
    """The confusion matrix of whole images ``(K, K)``, integer counts summed over processes."""

    def compute(self) -> NDArray[np.int64]:  # type: ignore[override]
        """The matrix of all processes: rows truth, columns prediction."""
        counts: NDArray[np.int64] = super().compute().cpu().numpy()
        return counts
