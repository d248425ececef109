"""Compiled loops that add the scores of one image to those of a panorama or photo."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_exact, njit_fast

__all__ = ["add_crop", "add_pinhole_image", "best_classes"]


@njit_fast
def _interpolate(
    scores: NDArray[np.float32],
    u: float,
    v: float,
    values: NDArray[np.float32],
) -> None:
    """Bilinear sample of ``(h, w, K)`` scores at column u and row v, clamped to the image."""
    height, width = scores.shape[:2]
    x = min(max(u, 0.0), width - 1.0)
    y = min(max(v, 0.0), height - 1.0)
    left, top = int(x), int(y)
    right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
    across, down = np.float32(x - left), np.float32(y - top)
    for k in range(values.shape[0]):
        a, b = scores[top, left, k], scores[top, right, k]
        c, d = scores[bottom, left, k], scores[bottom, right, k]
        upper, lower = a + across * (b - a), c + across * (d - c)
        values[k] = upper + down * (lower - upper)


@njit_exact
def _first_best(values: NDArray[np.float32]) -> int:
    """Place of the largest value; the first of equal ones, and NaN never wins."""
    best, found = -np.inf, 0
    for k in range(values.shape[0]):
        if values[k] > best:
            best, found = values[k], k
    return found


@njit_exact
def _softmax(values: NDArray[np.float32]) -> None:
    highest = values[_first_best(values)]
    total = np.float32(0)
    for k in range(values.shape[0]):
        values[k] = math.exp(values[k] - highest)
        total += values[k]
    for k in range(values.shape[0]):
        values[k] /= total


@njit_exact
def _put(
    values: NDArray[np.float32],
    weight: float,
    softmax: bool,
    total: NDArray[np.float32],
    labels: NDArray[np.integer],
    i: int,
    j: int,
) -> None:
    """Add to the sums of a pixel, or, where no sums are kept, decide its label."""
    if total.shape[0] == 0:
        labels[i, j] = _first_best(values)
        return
    if softmax:
        _softmax(values)
    sums = total[i, j]
    for k in range(values.shape[0]):
        sums[k] += np.float32(weight) * values[k]


@njit_exact
def add_pinhole_image(
    start: int,
    stop: int,
    scores: NDArray[np.float32],
    axes: NDArray[np.float64],
    focal: float,
    power: int,
    rivals: NDArray[np.float64],
    earlier: int,
    softmax: bool,
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    first_column: int,
    num_columns: int,
    total: NDArray[np.float32],
    labels: NDArray[np.integer],
) -> None:
    """Add one pinhole image to the ERP rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(d, d, K)`` float32 of the image.
        axes: ``(3, 3)`` its camera axes, as columns.
        focal: Focal length in pixels.
        power: Exponent of the weights; 0 to add with weight 1 where the image is the owner.
        rivals: ``(M, 3)`` centres of the images that may own what this one does not.
        earlier: How many of them, the first ones, win a tie.
        softmax: Whether to turn the interpolated scores into probabilities.
        columns: From `directions_of_rows`.
        rows: From `directions_of_rows`.
        first_column: First column that may see something of the image.
        num_columns: How many may, across the seam.
        total: ``(H, W, K)`` float32 sums, changed; of length 0 to write labels instead.
        labels: ``(H, W)`` places of the best class, written where `total` is empty.
    """
    half = scores.shape[0] / 2
    width = columns.shape[0]
    values = np.empty(scores.shape[2], np.float32)
    for i in range(start, stop):
        z = rows[i, 1]
        for n in range(num_columns):
            j = (first_column + n) % width
            x, y = rows[i, 0] * columns[j, 0], rows[i, 0] * columns[j, 1]
            depth = axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z
            if depth <= 0:
                continue
            scale = focal / depth
            a = (axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z) * scale
            b = (axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z) * scale
            weight = 1.0
            if power > 0:
                if abs(a) >= half or abs(b) >= half:
                    continue
                weight = ((1 - (a / half) ** 2) * (1 - (b / half) ** 2)) ** power
            else:
                own = True
                for m in range(rivals.shape[0]):
                    other = rivals[m, 0] * x + rivals[m, 1] * y + rivals[m, 2] * z
                    if other > depth or (other == depth and m < earlier):
                        own = False
                        break
                if not own:
                    continue
            _interpolate(scores, a + half - 0.5, b + half - 0.5, values)
            _put(values, weight, softmax, total, labels, i, j)


@njit_exact
def add_crop(
    start: int,
    stop: int,
    scores: NDArray[np.float32],
    box: NDArray[np.float64],
    cell: NDArray[np.float64],
    power: int,
    softmax: bool,
    total: NDArray[np.float32],
    labels: NDArray[np.integer],
) -> None:
    """Add one crop to the rows ``start:stop`` of its photo.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(h, w, K)`` float32 of the crop.
        box: Left, top, right and bottom of the crop in the photo, in pixels from its corner.
        cell: Likewise the part of the photo that the crop owns.
        power: Exponent of the weights; 0 to add with weight 1 in the crop's cell.
        softmax: Whether to turn the interpolated scores into probabilities.
        total: ``(H, W, K)`` float32 sums, changed; of length 0 to write labels instead.
        labels: ``(H, W)`` places of the best class, written where `total` is empty.
    """
    part = box if power > 0 else cell
    values = np.empty(scores.shape[2], np.float32)
    for i in range(start, stop):
        y = i + 0.5
        if y < part[1] or y >= part[3]:
            continue
        down = (y - box[1]) / (box[3] - box[1])
        for j in range(labels.shape[1]):
            x = j + 0.5
            if x < part[0] or x >= part[2]:
                continue
            across = (x - box[0]) / (box[2] - box[0])
            weight = 1.0
            if power > 0:
                weight = (16 * across * (1 - across) * down * (1 - down)) ** power
            _interpolate(
                scores, across * scores.shape[1] - 0.5, down * scores.shape[0] - 0.5, values
            )
            _put(values, weight, softmax, total, labels, i, j)


@njit_exact
def best_classes(
    start: int,
    stop: int,
    total: NDArray[np.float32],
    labels: NDArray[np.integer],
) -> None:
    """Place of the largest sum of every pixel of the rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        total: ``(H, W, K)`` sums.
        labels: ``(H, W)``, written.
    """
    for i in range(start, stop):
        for j in range(labels.shape[1]):
            labels[i, j] = _first_best(total[i, j])
