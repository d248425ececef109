"""Compiled loops: where pixels are on the sphere, who owns them, and adding images to a canvas.

A *canvas* is what images are put together on: a panorama, or a photo made of crops. Its pixel
(i, j) looks along the ray ``(rows[i, 0] columns[j, 0], rows[i, 0] columns[j, 1], rows[i, 1])``;
`sphere_rays` and `plane_rays` give these factors. An image sees the ray at its pixel (u, v) where
``(u, v, 1)`` is proportional to its ``(3, 3)`` matrix times the ray, if the third number is
positive.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_exact, njit_fast

__all__ = [
    "FEATHER_POWER",
    "add_images",
    "best_classes",
    "equirect_map",
    "owners",
    "plane_rays",
    "seen_table",
    "sphere_rays",
]

FEATHER_POWER = 4
"""Exponent p of the feather weights ((1 − a²)(1 − b²))^p at offsets a, b in half image sides."""

_LANES = 16
"""Sums of a pixel are padded to a multiple of this, which compiles to vector code."""

_TILE = 64
"""Rows and columns added to at once, so that their sums stay in the cache."""

Rays = tuple[NDArray[np.float64], NDArray[np.float64]]
"""``(W, 2)`` factors of the columns and ``(H, 2)`` factors of the rows."""


def sphere_rays(shape: tuple[int, int]) -> Rays:
    """Unit directions of a panorama's pixels: cos λ, sin λ and cos φ, sin φ."""
    height, width = shape
    lon = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    lat = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    return np.stack([np.cos(lon), np.sin(lon)], -1), np.stack([np.cos(lat), np.sin(lat)], -1)


def plane_rays(shape: tuple[int, int]) -> Rays:
    """``(j, 1, i)`` of the pixels of an image: its homogeneous pixels in another order."""
    height, width = shape
    columns = np.stack([np.arange(width, dtype=np.float64), np.ones(width)], -1)
    return columns, np.stack([np.ones(height), np.arange(height, dtype=np.float64)], -1)


@njit_exact
def equirect_map(
    start: int,
    stop: int,
    matrices: NDArray[np.float64],
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    height: int,
    width: int,
    u: NDArray[np.floating],
    v: NDArray[np.floating],
) -> None:
    """ERP positions of the rays of canvases, one below the other, rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        matrices: ``(n, 3, 3)`` from each canvas's rays to directions of any length.
        columns: ``(w, 2)`` of the rays.
        rows: ``(h, 2)`` of the rays.
        height: Rows H of the ERP.
        width: Columns W of the ERP.
        u: ``(n h, w)`` columns in the ERP, written.
        v: ``(n h, w)`` rows in the ERP, written.
    """
    for row in range(start, stop):
        m = matrices[row // len(rows)]
        i = row % len(rows)
        c = rows[i, 1]
        for j in range(len(columns)):
            a, b = rows[i, 0] * columns[j, 0], rows[i, 0] * columns[j, 1]
            x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
            y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c
            z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
            u[row, j] = (math.atan2(y, x) / (2 * math.pi) + 0.5) * width - 0.5
            v[row, j] = (0.5 - math.atan2(z, math.sqrt(x * x + y * y)) / math.pi) * height - 0.5


@njit_exact
def owners(
    start: int,
    stop: int,
    centers: NDArray[np.float64],
    neighbors: NDArray[np.integer],
    inner: float,
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    face: NDArray[np.integer],
) -> None:
    """The image with the nearest centre, for the ERP rows ``start:stop``.

    Walks to ever nearer centres, from the owner of the pixel before.

    Args:
        start: First row.
        stop: One past the last row.
        centers: ``(N, 3)`` directions of the images' centres.
        neighbors: ``(N, k)`` images around every image.
        inner: Cosine of half the angle between the nearest two centres: a centre nearer than that
            is the nearest.
        columns: From `sphere_rays`.
        rows: From `sphere_rays`.
        face: ``(H, W)`` owners, written.
    """
    own = 0
    for i in range(start, stop):
        z = rows[i, 1]
        for j in range(len(columns)):
            x, y = rows[i, 0] * columns[j, 0], rows[i, 0] * columns[j, 1]
            best = centers[own, 0] * x + centers[own, 1] * y + centers[own, 2] * z
            while best < inner:
                nearer = own
                for other in neighbors[own]:
                    dot = centers[other, 0] * x + centers[other, 1] * y + centers[other, 2] * z
                    if dot > best:
                        best, nearer = dot, other
                if nearer == own:
                    break
                own = nearer
            face[i, j] = own


@njit_fast
def _project(
    side: tuple[int, int],
    m: NDArray[np.float64],
    feather: bool,
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    weight: NDArray[np.floating],
) -> None:
    """Where an image sees rays ``(u, v, weight)``, which become columns, rows and weights."""
    for p in range(len(u)):
        x, y, z = u[p], v[p], weight[p]
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
        u[p] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) / depth
        v[p] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) / depth
        weight[p] = 1.0
        if feather:
            across, down = (2 * u[p] + 1) / side[1] - 1, (2 * v[p] + 1) / side[0] - 1
            seen = depth > 0 and abs(across) < 1 and abs(down) < 1
            weight[p] = ((1 - across**2) * (1 - down**2)) ** FEATHER_POWER if seen else 0.0


@njit_fast
def _list_seen(
    tile: tuple[int, int, int, int],
    image: int,
    side: tuple[int, int],
    matrix: NDArray[np.float64],
    spans: NDArray[np.integer],
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    owner: NDArray[np.integer],
    pixel: NDArray[np.integer],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    weight: NDArray[np.floating],
) -> int:
    """List the pixels of a tile to which an image gives something.

    Args:
        tile: First row and the one after the last, first column and the one after the last.
        image: Its number, as it stands in `owner`.
        side: Its rows and columns.
        matrix: ``(3, 3)`` from rays to its pixels.
        spans: ``(H, 2)`` in every row the first column that may see something of the image, and how
            many may, across the seam.
        columns: ``(W, 2)`` of the rays.
        rows: ``(H, 2)`` of the rays.
        owner: ``(H, W)``: weight 1 where the image is the owner. Empty: feather weights, 1 in the
            middle of the image and 0 at the outer edges of its outermost pixels.
        pixel: Flat indices in the tile, written.
        u: Columns in the image, written.
        v: Rows in the image, written.
        weight: Weights, written.

    Returns:
        Number of pixels.
    """
    top, bottom, left, right = tile
    count = 0
    for i in range(top, bottom):
        span = spans[i, 1]
        ahead = left - spans[i, 0] if left >= spans[i, 0] else left - spans[i, 0] + len(columns)
        if span == 0 or (ahead >= span and ahead + right - left <= len(columns)):
            continue
        at = (i - top) * (right - left) - left
        x, z = rows[i, 0], rows[i, 1]
        for back in range(0, len(columns) + 1, len(columns)):
            first = max(left, spans[i, 0] - back)
            last = min(right, spans[i, 0] + span - back)
            if len(owner) == 0:
                for j in range(first, last):
                    p = count + j - first
                    pixel[p], u[p], v[p] = at + j, x * columns[j, 0], x * columns[j, 1]
                    weight[p] = z
                count += max(0, last - first)
                continue
            for j in range(first, last):
                if owner[i, j] == image:
                    pixel[count], u[count], v[count] = at + j, x * columns[j, 0], x * columns[j, 1]
                    weight[count] = z
                    count += 1
    _project(side, matrix, len(owner) == 0, u[:count], v[:count], weight[:count])
    kept = 0
    for p in range(count):
        if weight[p] > 0:
            pixel[kept], u[kept], v[kept], weight[kept] = pixel[p], u[p], v[p], weight[p]
            kept += 1
    return kept


@njit_fast
def _split(
    places: NDArray[np.floating],
    count: int,
    whole: NDArray[np.integer],
    share: NDArray[np.floating],
) -> tuple[int, int]:
    """Split positions along an axis of `count` pixels, clamped to them, for interpolation.

    Args:
        places: ``(n,)``.
        count: Pixels of the axis.
        whole: ``(n,)`` the first of the two pixels around a position, written.
        share: ``(n,)`` of the second, 0 to 1, written.

    Returns:
        Least and greatest `whole`.
    """
    least, greatest = np.int32(count), np.int32(0)
    for p in range(len(places)):
        place = min(max(places[p], 0.0), count - 1.0)
        first = min(np.int32(place), np.int32(count - 2))
        whole[p], share[p] = first, place - first
        least, greatest = min(least, first), max(greatest, first)
    return int(least), int(greatest)


@njit_fast
def _copy_patch(
    scores: NDArray[np.float32],
    left: int,
    top: int,
    height: int,
    width: int,
    lanes: int,
    patch: NDArray[np.float32],
) -> None:
    """Copy a part of ``(K, h, w)`` scores so that those of a pixel lie together, and a 1."""
    for y in range(height):
        for k in range(scores.shape[0]):
            line = scores[k, top + y]
            at = np.uint64(y * width * lanes + k)
            for x in range(left, left + width):
                patch[at] = line[x]
                at += np.uint64(lanes)
        at = np.uint64(y * width * lanes + scores.shape[0])
        for _ in range(width):
            patch[at] = 1
            at += np.uint64(lanes)


@njit_fast
def _add_patch(
    patch: NDArray[np.float32],
    corner: NDArray[np.uint64],
    below: np.uint64,
    lanes: np.uint64,
    right_share: NDArray[np.float32],
    below_share: NDArray[np.float32],
    weight: NDArray[np.floating],
    pixel: NDArray[np.integer],
    sums: NDArray[np.float32],
) -> None:
    """Add weighted bilinear samples of a patch to the sums of a tile.

    Unsigned indices spare numba's test for negative ones.

    Args:
        patch: Flat ``(h, w, lanes)``.
        corner: ``(n,)`` where the first of four pixels starts.
        below: From there to the pixel below.
        lanes: From there to the pixel to the right.
        right_share: ``(n,)`` of the pixels to the right.
        below_share: ``(n,)`` of the pixels below.
        weight: ``(n,)`` of the samples.
        pixel: ``(n,)`` pixels of the tile.
        sums: Flat ``(pixels, lanes)``, changed.
    """
    for p in range(np.uint64(len(corner))):
        a = corner[p]
        b, c = a + lanes, a + below
        d, to = b + below, np.uint64(pixel[p]) * lanes
        lower = np.float32(weight[p]) * below_share[p]
        upper = np.float32(weight[p]) - lower
        wb, wd = right_share[p] * upper, right_share[p] * lower
        wa, wc = upper - wb, lower - wd
        for k in range(lanes):
            sums[to + k] += (
                wa * patch[a + k] + wb * patch[b + k] + wc * patch[c + k] + wd * patch[d + k]
            )


@njit_fast
def _best_class(sums: NDArray[np.float32], num_classes: int) -> int:
    """Of the largest sum: the first of equal ones, and NaN never wins."""
    best, found = np.float32(-np.inf), 0
    for k in range(num_classes):
        if sums[k] > best:
            best, found = sums[k], k
    return found


@njit_fast
def _finish(
    tile: tuple[int, int, int, int],
    num_classes: int,
    softmax: bool,
    sums: NDArray[np.float32],
    total: NDArray[np.float32],
    labels: NDArray[np.integer],
) -> None:
    """Of the pixels of a tile that got something, add the sums to the totals or write the label."""
    top, bottom, left, right = tile
    p = -1
    for i in range(top, bottom):
        for j in range(left, right):
            p += 1
            found = sums[p]
            if not found[num_classes] > 0:
                continue
            if len(total) == 0:
                labels[i, j] = _best_class(found, num_classes)
                continue
            if softmax:
                highest = found[_best_class(found, num_classes)]
                whole = np.float32(0)
                for k in range(num_classes):
                    found[k] = math.exp(found[k] - highest)
                    whole += found[k]
                for k in range(num_classes):
                    found[k] /= whole
            for k in range(num_classes + 1):
                total[i, j, k] += found[k]


@njit_fast
def add_images(
    start: int,
    stop: int,
    scores: NDArray[np.float32],
    images: NDArray[np.integer],
    matrices: NDArray[np.float64],
    spans: NDArray[np.integer],
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    owner: NDArray[np.integer],
    softmax: bool,
    total: NDArray[np.float32],
    labels: NDArray[np.integer],
) -> None:
    """Add images to rows ``start:stop`` of a canvas: weighted scores, or at once the best class.

    Works tile by tile. The part of an image that a tile sees is copied so that the scores of a
    pixel lie together, those of all classes are interpolated at once.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(n, K, h, w)``, h and w at least 2.
        images: ``(n,)`` their numbers, as they stand in `owner`.
        matrices: ``(n, 3, 3)`` from rays to their pixels.
        spans: ``(n, H, 2)`` in every row the first column that may see something of an image, and
            how many may, across the seam.
        columns: ``(W, 2)`` of the rays.
        rows: ``(H, 2)`` of the rays.
        owner: ``(H, W)`` owner of every pixel; empty for feather weights.
        softmax: Whether scores become probabilities after they are interpolated; not feathered.
        total: ``(H, W, K + 1)`` weighted sums, and the sum of the weights, changed. Empty where
            only labels are wanted, for which all images of a pixel have to come at once.
        labels: ``(H, W)`` best classes, written where `total` is empty.
    """
    num_classes = scores.shape[1]
    side = scores.shape[2], scores.shape[3]
    lanes = (num_classes // _LANES + 1) * _LANES
    pixel = np.empty(_TILE**2, np.int32)
    u, v, weight = np.empty((3, _TILE**2))
    column, row = np.empty((2, _TILE**2), np.int32)
    right, below = np.empty((2, _TILE**2), np.float32)
    begin = np.empty(_TILE**2, np.uint64)
    sums = np.empty((_TILE**2, lanes), np.float32)
    patch = np.empty(0, np.float32)
    for top in range(start, stop, _TILE):
        for left in range(0, len(columns), _TILE):
            tile = top, min(stop, top + _TILE), left, min(len(columns), left + _TILE)
            sums[:] = 0
            for m in range(len(images)):
                n = _list_seen(
                    tile, images[m], side, matrices[m], spans[m], columns, rows, owner,
                    pixel, u, v, weight,
                )  # fmt: skip
                if n == 0:
                    continue
                first, last = _split(u[:n], side[1], column, right)
                upper, lower = _split(v[:n], side[0], row, below)
                width, height = last - first + 2, lower - upper + 2
                if len(patch) < height * width * lanes:
                    patch = np.empty(height * width * lanes, np.float32)
                _copy_patch(scores[m], first, upper, height, width, lanes, patch)
                for p in range(n):
                    index = (row[p] - upper) * width + column[p] - first
                    begin[p] = np.uint64(index * lanes)
                _add_patch(
                    patch, begin[:n], np.uint64(width * lanes), np.uint64(lanes), right, below,
                    weight, pixel, sums.reshape(-1),
                )  # fmt: skip
            _finish(tile, num_classes, softmax, sums, total, labels)


@njit_exact
def best_classes(
    start: int, stop: int, total: NDArray[np.float32], labels: NDArray[np.integer]
) -> None:
    """Best class of the ``(H, W, K + 1)`` totals of `add_images`, rows ``start:stop``."""
    for i in range(start, stop):
        for j in range(labels.shape[1]):
            labels[i, j] = _best_class(total[i, j], total.shape[2] - 1)


@njit_exact
def seen_table(
    start: int,
    stop: int,
    side: tuple[int, int],
    matrices: NDArray[np.float64],
    spans: NDArray[np.integer],
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    owner: NDArray[np.integer],
    count: NDArray[np.integer],
    face: NDArray[np.integer],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
    weight: NDArray[np.floating],
) -> None:
    """All images that give something to a pixel, for the rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        side: Rows and columns of the images.
        matrices: ``(N, 3, 3)``; this and the next four as in `add_images`.
        spans: ``(N, H, 2)``.
        columns: ``(W, 2)``.
        rows: ``(H, 2)``.
        owner: ``(H, W)`` or empty.
        count: ``(H, W)`` how many images there are, 0 before, written.
        face: ``(R, H, W)`` images, written; with R = 0 they are only counted.
        u: ``(R, H, W)`` columns in the images, written.
        v: ``(R, H, W)`` rows in the images, written.
        weight: ``(R, H, W)`` weights, written.
    """
    pixel = np.empty(len(columns), np.int32)
    line_u, line_v, line_w = np.empty((3, len(columns)))
    for i in range(start, stop):
        for m in range(len(matrices)):
            tile = i, i + 1, 0, len(columns)
            n = _list_seen(
                tile, m, side, matrices[m], spans[m], columns, rows, owner,
                pixel, line_u, line_v, line_w,
            )  # fmt: skip
            for p in range(n):
                j = pixel[p]
                rank = count[i, j]
                count[i, j] += 1
                if rank < len(face):
                    face[rank, i, j], weight[rank, i, j] = m, line_w[p]
                    u[rank, i, j], v[rank, i, j] = line_u[p], line_v[p]
