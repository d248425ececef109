"""Compiled loops over all images that see a panorama's pixels: feathering."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_exact, njit_fast

__all__ = ["feather_labels", "feather_table"]

_TILE = (32, 64)
"""Rows and columns rendered at once, so that a class plane's part of it stays in the cache."""


@njit_fast
def _corner(
    u: float,
    v: float,
    dim: int,
) -> tuple[int, np.float32, np.float32]:
    """First of the four pixels around a position, as a flat index, and the two fractions."""
    x = min(max(u, 0.0), dim - 1.0)
    y = min(max(v, 0.0), dim - 1.0)
    left = min(int(x), dim - 2)
    top = min(int(y), dim - 2)
    return top * dim + left, np.float32(x - left), np.float32(y - top)


@njit_fast
def _interpolate(
    plane: NDArray[np.float32],
    dim: int,
    corner: NDArray[np.uint64],
    right: NDArray[np.float32],
    below: NDArray[np.float32],
    scores: NDArray[np.float32],
) -> None:
    """Bilinear samples of a flat plane; unsigned indices spare numba's test for negative ones."""
    one, step = np.uint64(1), np.uint64(dim)
    for p in range(scores.shape[0]):
        c = corner[p]
        upper = plane[c] + right[p] * (plane[c + one] - plane[c])
        c += step
        lower = plane[c] + right[p] * (plane[c + one] - plane[c])
        scores[p] = upper + below[p] * (lower - upper)


@njit_fast
def _keep_better(
    scores: NDArray[np.float32],
    k: int,
    best: NDArray[np.float32],
    label: NDArray[np.integer],
) -> None:
    """Branch-free running argmax; a loop of its own, so that it compiles to vector code."""
    for p in range(scores.shape[0]):
        score, before, kept = scores[p], best[p], label[p]
        better = score > before
        best[p] = score if better else before
        label[p] = k if better else kept


@njit_exact
def _list_images(
    owners: NDArray[np.integer],
    near: NDArray[np.integer],
    listed: NDArray[np.bool_],
    images: NDArray[np.integer],
) -> int:
    """List the images that can see a tile.

    Args:
        owners: ``(h, w)`` owners of the tile.
        near: ``(N, M)`` images that can see something a face owns, filled up with −1.
        listed: ``(N,)`` scratch, all False before and after.
        images: ``(N,)`` list, written.

    Returns:
        Their number.
    """
    count = 0
    previous = -1
    for i in range(owners.shape[0]):
        for j in range(owners.shape[1]):
            own = owners[i, j]
            if own == previous:
                continue
            previous = own
            for image in near[own]:
                if image >= 0 and not listed[image]:
                    listed[image] = True
                    images[count] = image
                    count += 1
    for n in range(count):
        listed[images[n]] = False
    return count


@njit_fast
def _list_seen(
    axes: NDArray[np.float64],
    focal: float,
    half: float,
    power: int,
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    pixel: NDArray[np.integer],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    weight: NDArray[np.floating],
) -> int:
    """List the pixels of a tile that an image sees, with their positions in it and weights.

    The weight is 1 in the middle of the image and falls to 0 at the outer edges of its outermost
    pixels: half a pixel beyond the centres, so that every direction has an image of weight > 0.

    Args:
        axes: ``(3, 3)`` camera axes of the image, as columns.
        focal: Focal length in pixels.
        half: Half the side in pixels.
        power: Exponent of the weights.
        columns: ``(w, 2)`` from `directions_of_rows`.
        rows: ``(h, 2)`` from `directions_of_rows`.
        pixel: List of flat indices in the tile, written.
        u: Columns in the image, written.
        v: Rows in the image, written.
        weight: Weights, written.

    Returns:
        Number of pixels listed.
    """
    count = 0
    for i in range(rows.shape[0]):
        z = rows[i, 1]
        for j in range(columns.shape[0]):
            x = rows[i, 0] * columns[j, 0]
            y = rows[i, 0] * columns[j, 1]
            depth = axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z
            if depth <= 0:
                continue
            scale = focal / depth
            a = (axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z) * scale
            b = (axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z) * scale
            if abs(a) < half and abs(b) < half:
                pixel[count] = i * columns.shape[0] + j
                u[count] = a + half - 0.5
                v[count] = b + half - 0.5
                weight[count] = ((1 - (a / half) ** 2) * (1 - (b / half) ** 2)) ** power
                count += 1
    return count


@njit_fast
def feather_labels(
    start: int,
    stop: int,
    scores: NDArray[np.float32],
    owners: NDArray[np.integer],
    near: NDArray[np.integer],
    axes: NDArray[np.float64],
    focal: float,
    power: int,
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    labels: NDArray[np.integer],
) -> None:
    """Class of the largest weighted sum of scores of all images that see a pixel.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(N, K, d, d)`` float32.
        owners: ``(H, W)`` owners.
        near: ``(N, M)`` images that can see something a face owns, filled up with −1.
        axes: ``(N, 3, 3)`` camera axes of the images, as columns.
        focal: Focal length of the images in pixels.
        power: Exponent of the weights.
        columns: From `directions_of_rows`.
        rows: From `directions_of_rows`.
        labels: ``(H, W)`` class indices, written.
    """
    num_images, num_classes, dim = scores.shape[:3]
    planes = scores.reshape(num_images, num_classes, dim * dim)
    listed, images = np.zeros(num_images, np.bool_), np.empty(num_images, np.int64)
    pixel = np.empty(_TILE[0] * _TILE[1], np.int64)
    u, v, weight = np.empty((3, len(pixel)))
    corner = np.empty(len(pixel), np.uint64)
    right, below, score, best = np.empty((4, len(pixel)), np.float32)
    total = np.empty((num_classes, len(pixel)), np.float32)
    label = np.empty(len(pixel), np.int32)
    for top in range(start, stop, _TILE[0]):
        bottom = min(stop, top + _TILE[0])
        for left in range(0, owners.shape[1], _TILE[1]):
            end = min(owners.shape[1], left + _TILE[1])
            n = (bottom - top) * (end - left)
            total[:] = 0
            for m in range(_list_images(owners[top:bottom, left:end], near, listed, images)):
                image = images[m]
                seen = _list_seen(
                    axes[image], focal, dim / 2, power, columns[left:end], rows[top:bottom],
                    pixel, u, v, weight,
                )  # fmt: skip
                for q in range(seen):
                    corner[q], right[q], below[q] = _corner(u[q], v[q], dim)
                for k in range(num_classes):
                    _interpolate(planes[image, k], dim, corner, right, below, score[:seen])
                    for q in range(seen):
                        total[k, pixel[q]] += np.float32(weight[q]) * score[q]
            best[:] = -np.inf
            label[:] = 0
            for k in range(num_classes):
                _keep_better(total[k, :n], k, best, label)
            labels[top:bottom, left:end] = label[:n].reshape(bottom - top, end - left)


@njit_exact
def feather_table(
    start: int,
    stop: int,
    owners: NDArray[np.integer],
    near: NDArray[np.integer],
    axes: NDArray[np.float64],
    focal: float,
    half: float,
    power: int,
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    count: NDArray[np.integer],
    face: NDArray[np.integer],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    weight: NDArray[np.floating],
) -> None:
    """All images that see a pixel, positions and weights, for the rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        owners: ``(H, W)`` owners.
        near: ``(N, M)`` images that can see something a face owns, filled up with −1.
        axes: ``(N, 3, 3)`` camera axes of the images, as columns.
        focal: Focal length of the images in pixels.
        half: Half the side of the images in pixels.
        power: Exponent of the weights.
        columns: From `directions_of_rows`.
        rows: From `directions_of_rows`, those of `owners`.
        count: ``(H, W)`` number of images that see a pixel, 0 before, written.
        face: ``(R, H, W)`` images, written; with R = 0 pixels are only counted. A pixel seen by
            fewer repeats its first one with weight 0.
        u: ``(R, H, W)`` columns in the images, written.
        v: ``(R, H, W)`` rows in the images, written.
        weight: ``(R, H, W)`` weights, 0 before, written: they add up to 1.
    """
    num_images, width = axes.shape[0], owners.shape[1]
    listed, images = np.zeros(num_images, np.bool_), np.empty(num_images, np.int64)
    pixel = np.empty(_TILE[0] * width, np.int64)
    line_u, line_v, line_w = np.empty((3, len(pixel)))
    for top in range(start, stop):
        for left in range(0, width, _TILE[1]):
            end = min(width, left + _TILE[1])
            for m in range(_list_images(owners[top : top + 1, left:end], near, listed, images)):
                seen = _list_seen(
                    axes[images[m]], focal, half, power, columns[left:end], rows[top : top + 1],
                    pixel, line_u, line_v, line_w,
                )  # fmt: skip
                for q in range(seen):
                    p = left + pixel[q]
                    rank = count[top, p]
                    count[top, p] += 1
                    if rank < face.shape[0]:
                        face[rank, top, p] = images[m]
                        u[rank, top, p] = line_u[q]
                        v[rank, top, p] = line_v[q]
                        weight[rank, top, p] = line_w[q]
        for p in range(width):
            _finish_ranks(count[top, p], face[:, top, p], u[:, top, p], v[:, top, p],
                          weight[:, top, p])  # fmt: skip


@njit_exact
def _finish_ranks(
    count: int,
    face: NDArray[np.integer],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    weight: NDArray[np.floating],
) -> None:
    """Scale the weights of one pixel to sum 1 and fill up the images."""
    total = weight.sum()
    for rank in range(len(face)):
        weight[rank] /= total
        if rank >= count:
            face[rank], u[rank], v[rank] = face[0], u[0], v[0]
