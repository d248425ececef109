"""Confidences that labels need to be kept, balanced by class, for labels that train a network.

One threshold for all classes keeps few pixels of rare classes, whose confidence is lower. The
thresholds of each class, a quantile of its confidences, are those of class-balanced self-training
(Zou et al., ECCV 2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BINS = 256


def count_confidences(
    labels: NDArray[np.integer], confidences: NDArray[np.floating], num_classes: int
) -> NDArray[np.int64]:
    """Return ``(K + 1, bins)`` pixels of each label by confidence from 0 to 1.

    Args:
        labels: Labels from 0 to K.
        confidences: Confidence of each of them.
        num_classes: K.
    """
    place = np.minimum(confidences * _BINS, _BINS - 1).astype(np.int64)
    place += labels.astype(np.int64) * _BINS
    return np.bincount(place.ravel(), minlength=(num_classes + 1) * _BINS).reshape(-1, _BINS)


def class_thresholds(
    counts: NDArray[np.int64], most: float, min_share: float
) -> NDArray[np.float64]:
    """Return the confidence that pixels of each label need, ``(K + 1,)``.

    Args:
        counts: Result of `count_confidences`.
        most: Largest threshold, which labels without counted pixels have.
        min_share: Share of the counted pixels of each label that is kept at least.

    >>> counts = count_confidences(np.array([1, 1, 1, 1]), np.array([0.3, 0.5, 0.75, 0.95]), 2)
    >>> class_thresholds(counts, 0.9, 0.5).tolist()
    [0.9, 0.75, 0.9]
    """
    kept = counts[:, ::-1].cumsum(axis=1)[:, ::-1]  # at or above the lower edge of each bin
    is_enough = kept >= min_share * kept[:, :1]
    return np.minimum((is_enough.sum(axis=1) - 1) / _BINS, most)
