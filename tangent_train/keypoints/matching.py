"""Match keypoints: exact nearest neighbors among descriptors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_ROWS = 512
"""Number of left descriptors whose distances are computed at once."""


def match(
    left_descriptors: NDArray[np.float32],
    right_descriptors: NDArray[np.float32],
    ratio: float = 0.8,
    *,
    mutual: bool = True,
) -> NDArray[np.int64]:
    """Match each left descriptor with its nearest right descriptor, if that is unambiguous.

    Time grows with n_l · n_r, memory with n_r. Distances have no rounding errors for integers up to
    255, such as SIFT's. The first of several equally near descriptors is taken.

    Args:
        left_descriptors: ``(n_l, D)`` descriptors.
        right_descriptors: ``(n_r, D)`` descriptors.
        ratio: Keep a match if its Euclidean distance is less than this share of the distance to the
            second nearest (Lowe 2004; the paper uses 0.8). 1 or more keeps all.
        mutual: True to keep a match only if each descriptor is the nearest to the other.

    Returns:
        ``(m, 2)`` indices of left and right descriptors, sorted by the left ones.
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
    """Return ``(n,)`` index and squared distance of the nearest, squared distance of the second."""
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
