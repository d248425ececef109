"""Classification: one confusion matrix over the data set, and scores computed from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torchmetrics.classification import MulticlassConfusionMatrix


class ClassificationScores(NamedTuple):
    """Scores of one confusion matrix.

    Attributes:
        accuracy: Share of images that were classified correctly.
        class_accuracy: Mean of `of_class`, in which all classes have the same weight.
        of_class: ``(K,)`` share of each class's images that were classified correctly; NaN for
            classes that do not occur, which are left out of the mean.
        counts: ``(K,)`` number of images of each class.
    """

    accuracy: float
    class_accuracy: float
    of_class: NDArray[np.float64]
    counts: NDArray[np.int64]


def classification_scores(confusion: ArrayLike) -> ClassificationScores:
    """Compute classification scores of a whole data set.

    Args:
        confusion: ``(K, K)`` counts; rows are the true classes, columns the predicted ones.

    Returns:
        The scores; NaN without images.
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
    """Counts images in a confusion matrix ``(K, K)``, summed over processes."""

    def compute(self) -> NDArray[np.int64]:  # type: ignore[override]
        """Return the matrix of all processes; rows are the true classes."""
        counts: NDArray[np.int64] = super().compute().cpu().numpy()
        return counts
