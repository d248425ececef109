"""Putative matches: exact nearest neighbours among descriptors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_ROWS = 512
"""Rows of the block of distances that is held."""


def match(
    left_descriptors: NDArray[np.float32],
    right_descriptors: NDArray[np.float32],
    ratio: float = 0.8,
    *,
    mutual: bool = True,
) -> NDArray[np.int64]:
    """The unambiguous nearest right descriptor of every left one.

    Time grows with n_l · n_r, memory with n_r. Distances are exact for whole numbers up to 255, as
    SIFT's. Of equally near right descriptors the first is the nearest.

    Args:
        left_descriptors: ``(n_l, D)``.
        right_descriptors: ``(n_r, D)``.
        ratio: Keep a match whose Euclidean distance is less than this share of that to the second
            nearest (Lowe 2004; the paper's matches have 0.8). 1 or more: keep all.
        mutual: Keep a match only if the left one is also the nearest to the right one.

    Returns:
        ``(m, 2)`` indices of left and right descriptors, by the left ones.
    """
    left, right = left_descriptors, right_descriptors
    if not (len(left) and len(right)):
        return np.empty((0, 2), np.int64)
    nearest, first, second = _nearest_two(left, right)
    chosen = np.flatnonzero(first < ratio**2 * second) if ratio < 1 else np.arange(len(left))
    if mutual and len(chosen):
        back, _, _ = _nearest_two(right[nearest[chosen]], left)
        chosen = chosen[back == chosen]
    return np.stack([chosen, nearest[chosen]], axis=1)


def _nearest_two(
    left: NDArray[np.float32], right: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """``(n,)`` index and squared distance of the nearest, squared distance of the second."""
    nearest = np.empty(len(left), np.int64)
    first, second = np.full((2, len(left)), np.inf)
    squares = np.einsum("nd,nd->n", right, right)
    for start in range(0, len(left), _ROWS):
        part = left[start : start + _ROWS]
        rows, every = slice(start, start + len(part)), np.arange(len(part))
        distances = squares + np.einsum("nd,nd->n", part, part)[:, None] - 2 * part @ right.T
        nearest[rows] = distances.argmin(axis=1)
        first[rows] = distances[every, nearest[rows]]
        distances[every, nearest[rows]] = np.inf
        second[rows] = distances.min(axis=1)
    return nearest, np.maximum(first, 0), np.maximum(second, 0)
