"""Compiled loops: positions on the sphere, owners of pixels, and adding images to a canvas.

A *canvas* is what images are put together on: a panorama, or a photo made of crops. Its pixel
(i, j) looks along the ray ``(rows[i, 0] columns[j, 0], rows[i, 0] columns[j, 1], rows[i, 1])``;
`sphere_rays` and `plane_rays` give these factors. An image sees the ray at its pixel (u, v) where
``(u, v, 1)`` is proportional to its ``(3, 3)`` matrix times the ray, if the third number is
positive.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_exact, njit_fast

__all__ = [
    "FEATHER_POWER",
    "Sight",
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
"""Rows and columns at the equator of what is added to at once: its sums stay in the cache."""

Array = NDArray[Any]
Rays = tuple[Array, Array]
"""``(W, 2)`` factors of the columns and ``(H, 2)`` factors of the rows, float64."""
Tile = tuple[int, int, int, int]
"""First row and the one after the last, first column and the one after the last."""


class Sight(NamedTuple):
    """Geometry of n images and a canvas of ``(H, W)`` pixels.

    Attributes:
        images: ``(n,)`` their numbers, as they stand in `owner`.
        matrices: ``(n, 3, 3)`` from rays to homogeneous pixels.
        spans: ``(n, H, 2)`` in every row the first column that may see something of an image, and
            how many may, across the seam. Not read where there are owners.
        columns: ``(W, 2)`` factors of the rays.
        rows: ``(H, 2)`` factors of the rays.
        owner: ``(H, W)``: an image has weight 1 where it is the owner, else 0. Empty for feather
            weights: 1 in the middle of an image, 0 at the outer edges of its outermost pixels.
    """

    images: Array
    matrices: Array
    spans: Array
    columns: Array
    rows: Array
    owner: Array


class _Seen(NamedTuple):
    """Pixels of a tile that an image contributes to.

    Attributes:
        pixel: Flat indices of them where results go.
        u: Columns in the image.
        v: Rows in the image.
        weight: Weights.
    """

    pixel: Array
    u: Array
    v: Array
    weight: Array


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
    start: int, stop: int, matrices: Array, columns: Array, rows: Array,
    height: int, width: int, u: Array, v: Array,
) -> None:  # fmt: skip
    """ERP positions of the rays of canvases, one below the other, rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        matrices: ``(n, 3, 3)`` from each canvas's rays to directions of any length.
        columns: ``(w, 2)`` factors of the rays.
        rows: ``(h, 2)`` factors of the rays.
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
    start: int, stop: int, centers: Array, neighbors: Array, inner: float,
    columns: Array, rows: Array, face: Array,
) -> None:  # fmt: skip
    """Find the image with the nearest centre, for the ERP rows ``start:stop``.

    Steps to ever nearer centres, starting from the owner of the previous pixel.

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
    side: tuple[int, int], m: Array, row: Array, columns: Array, feather: bool,
    start: int, stop: int, at: int, u: Array, v: Array, weight: Array,
) -> None:  # fmt: skip
    """Project neighbors in a row of the canvas into an image.

    Args:
        side: Rows and columns of the image.
        m: ``(3, 3)`` from rays to homogeneous pixels.
        row: ``(2,)`` factors of the row.
        columns: ``(W, 2)`` factors of the columns.
        feather: Whether weights fall to 0 at the image's borders, instead of being 1.
        start: First column.
        stop: One past the last column.
        at: Where the first one is written.
        u: Columns in the image, written.
        v: Rows in the image, written.
        weight: Weights, written.
    """
    ux, uy, uz = row[0] * m[0, 0], row[0] * m[0, 1], row[1] * m[0, 2]
    vx, vy, vz = row[0] * m[1, 0], row[0] * m[1, 1], row[1] * m[1, 2]
    wx, wy, wz = row[0] * m[2, 0], row[0] * m[2, 1], row[1] * m[2, 2]
    ahead = np.uint64(at - start)  # unsigned indices spare numba's test for negative ones
    for j in range(np.uint64(start), np.uint64(stop)):
        x, y, p = columns[j, 0], columns[j, 1], ahead + j
        depth = wx * x + wy * y + wz
        u[p] = (ux * x + uy * y + uz) / depth
        v[p] = (vx * x + vy * y + vz) / depth
        weight[p] = 1.0
        if feather:
            across, down = (2 * u[p] + 1) / side[1] - 1, (2 * v[p] + 1) / side[0] - 1
            seen = depth > 0 and abs(across) < 1 and abs(down) < 1
            weight[p] = ((1 - across**2) * (1 - down**2)) ** FEATHER_POWER if seen else 0.0


@njit_fast
def _count(sight: Sight) -> int:
    """One more than the greatest number of an image."""
    greatest = sight.images.max()
    return max(greatest, sight.owner.max()) + 1 if len(sight.owner) else greatest + 1


@njit_fast
def _mark_owners(tile: Tile, owner: Array, owns: Array) -> None:
    """Mark the images that own a pixel of a tile; all of them if they are feathered."""
    top, bottom, left, right = tile
    owns[:] = len(owner) == 0
    if len(owner) == 0:
        return
    for i in range(top, bottom):
        for j in range(left, right):
            owns[owner[i, j]] = True


@njit_fast
def _list_owned(
    tile: Tile, m: int, side: tuple[int, int], sight: Sight, step: tuple[int, int], seen: _Seen
) -> int:
    """See `_list_pixels`, of images that have weight 1 where they are the owner."""
    top, bottom, left, right = tile
    pixel, u, v, weight = seen
    count, image = 0, sight.images[m]
    for i in range(top, bottom):
        owner, at = sight.owner[i], i * step[0] + step[1]
        stop = left
        while stop < right:
            start = stop
            while start < right and owner[start] != image:
                start += 1
            stop = start
            while stop < right and owner[stop] == image:
                stop += 1
            _project(
                side, sight.matrices[m], sight.rows[i], sight.columns, False,
                start, stop, count, u, v, weight,
            )  # fmt: skip
            for p in range(np.uint64(stop - start)):
                pixel[np.uint64(count) + p] = at + start + p
            count += stop - start
    return count


@njit_fast
def _list_seen(
    tile: Tile, m: int, side: tuple[int, int], sight: Sight, step: tuple[int, int], seen: _Seen
) -> int:
    """See `_list_pixels`, of images that are feathered."""
    top, bottom, left, right = tile
    columns, (pixel, u, v, weight) = sight.columns, seen
    count = 0
    for i in range(top, bottom):
        begin, span = sight.spans[m, i, 0], sight.spans[m, i, 1]
        at = i * step[0] + step[1]
        for back in range(0, len(columns) + 1, len(columns)):
            start, stop = max(left, begin - back), min(right, begin + span - back)
            if start >= stop:
                continue
            _project(
                side, sight.matrices[m], sight.rows[i], columns, True,
                start, stop, count, u, v, weight,
            )  # fmt: skip
            first = count
            for p in range(first, first + stop - start):
                if weight[p] > 0:
                    u[count], v[count], weight[count] = u[p], v[p], weight[p]
                    pixel[count] = at + start + p - first
                    count += 1
    return count


@njit_fast
def _list_pixels(
    tile: Tile, m: int, side: tuple[int, int], sight: Sight, step: tuple[int, int], seen: _Seen
) -> int:
    """List the pixels of a tile that image m contributes to; returns how many.

    Args:
        tile: The tile.
        m: Index of the image in `sight`.
        side: Rows and columns of the image.
        sight: Geometry of images and canvas.
        step: From a row to the next one where results go, and there the place of pixel (0, 0).
        seen: The list, written.
    """
    if len(sight.owner) == 0:
        return _list_seen(tile, m, side, sight, step, seen)
    return _list_owned(tile, m, side, sight, step, seen)


@njit_fast
def _split(places: Array, count: int, whole: Array, share: Array) -> tuple[int, int]:
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
def _find_corners(
    row: Array, upper: int, column: Array, first: int, width: int, lanes: int, corner: Array
) -> None:
    """Where the first of four pixels starts in a patch of `width` columns."""
    for p in range(np.uint64(len(row))):
        corner[p] = ((row[p] - upper) * width + column[p] - first) * lanes


@njit_fast
def _copy_patch(
    scores: Array, left: int, top: int, height: int, width: int, lanes: int, patch: Array
) -> None:
    """Copy a part of ``(K, h, w)`` scores so that those of a pixel lie together, and a 1."""
    step, one = np.uint64(lanes), np.uint64(1)
    columns = np.uint64(left), np.uint64(left + width)
    num_classes = scores.shape[0]
    by_four = num_classes - num_classes % 4
    for y in range(height):
        lines, start = scores[:, top + y], y * width * lanes
        for k in range(0, by_four, 4):  # four stores side by side become one
            a, b, c, d = lines[k], lines[k + 1], lines[k + 2], lines[k + 3]
            at = np.uint64(start + k)
            for x in range(columns[0], columns[1]):
                patch[at], patch[at + one] = a[x], b[x]
                patch[at + one + one], patch[at + one + one + one] = c[x], d[x]
                at += step
        for k in range(by_four, num_classes):
            line, at = lines[k], np.uint64(start + k)
            for x in range(columns[0], columns[1]):
                patch[at] = line[x]
                at += step
        at = np.uint64(start + num_classes)
        for _ in range(width):
            patch[at] = 1
            at += step


@njit_fast
def _four_pixels(
    p: int, corner: Array, below: np.uint64, lanes: np.uint64,
    right_share: Array, below_share: Array, weight: np.float32,
) -> tuple[Any, ...]:  # fmt: skip
    """Where the scores of the four pixels around a position start in a patch, and their weights.

    Unsigned indices spare numba's test for negative ones.

    Args:
        p: The position.
        corner: ``(n,)`` where the first of four pixels starts.
        below: From there to the pixel below.
        lanes: From there to the pixel to the right.
        right_share: ``(n,)`` of the pixels to the right.
        below_share: ``(n,)`` of the pixels below.
        weight: Sum of the weights.
    """
    a = corner[p]
    c = a + below
    lower = weight * below_share[p]
    upper = weight - lower
    right, lower_right = right_share[p] * upper, right_share[p] * lower
    return a, a + lanes, c, c + lanes, upper - right, right, lower - lower_right, lower_right


@njit_fast
def _add_patch(
    patch: Array, corner: Array, below: np.uint64, lanes: np.uint64,
    right_share: Array, below_share: Array, weight: Array, pixel: Array, sums: Array,
) -> None:  # fmt: skip
    """Add weighted bilinear samples of a patch to the sums of a tile."""
    for p in range(np.uint64(len(corner))):
        a, b, c, d, wa, wb, wc, wd = _four_pixels(
            p, corner, below, lanes, right_share, below_share, np.float32(weight[p])
        )
        to = np.uint64(pixel[p]) * lanes
        for k in range(lanes):
            sums[to + k] += (
                wa * patch[a + k] + wb * patch[b + k] + wc * patch[c + k] + wd * patch[d + k]
            )


@njit_fast
def _label_patch(
    patch: Array, corner: Array, below: np.uint64, lanes: np.uint64,
    right_share: Array, below_share: Array, num_classes: np.uint64, pixel: Array, labels: Array,
) -> None:  # fmt: skip
    """Write the best class of bilinear samples of a patch; see `_best_class`."""
    for p in range(np.uint64(len(corner))):
        a, b, c, d, wa, wb, wc, wd = _four_pixels(
            p, corner, below, lanes, right_share, below_share, np.float32(1)
        )
        label: Any = np.uint64(0)  # as k: with int64 both would become floats
        best = np.float32(-np.inf)
        for k in range(num_classes):
            score = wa * patch[a + k] + wb * patch[b + k] + wc * patch[c + k] + wd * patch[d + k]
            better = score > best
            best, label = (score, k) if better else (best, label)
        labels[pixel[p]] = label


@njit_fast
def _best_class(sums: Array, num_classes: int) -> int:
    """Of the largest sum: the first of equal ones, and NaN never wins."""
    best, label = np.float32(-np.inf), 0
    for k in range(num_classes):
        better = sums[k] > best
        best, label = (sums[k], k) if better else (best, label)
    return label


@njit_fast
def _softmax(sums: Array, num_classes: int) -> None:
    """Of the first K numbers, in place."""
    highest = sums[_best_class(sums, num_classes)]
    whole = np.float32(0)
    for k in range(num_classes):
        sums[k] = math.exp(sums[k] - highest)
        whole += sums[k]
    for k in range(num_classes):
        sums[k] /= whole


@njit_fast
def _finish(
    tile: Tile, num_classes: int, softmax: bool, sums: Array, total: Array, labels: Array
) -> None:
    """Add the sums of a tile's covered pixels to the totals, or write their labels."""
    top, bottom, left, right = tile
    for i in range(top, bottom):
        for j in range(left, right):
            p = (i - top) * (right - left) + j - left
            if not sums[p, num_classes] > 0:
                continue
            if len(total) == 0:
                labels[i, j] = _best_class(sums[p], num_classes)
                continue
            if softmax:
                _softmax(sums[p], num_classes)
            for k in range(num_classes + 1):
                total[i, j, k] += sums[p, k]


@njit_fast
def _tile_size(stretch: float) -> tuple[int, int]:
    """Rows and columns of a tile that is about square on the sphere, of its first row's cos φ."""
    rows = max(1, int(_TILE * math.sqrt(stretch)))
    return rows, _TILE**2 // rows


@njit_fast
def add_images(
    start: int, stop: int, scores: Array, sight: Sight, softmax: bool, total: Array, labels: Array
) -> None:
    """Add images to rows ``start:stop`` of a canvas: weighted scores, or at once the best class.

    Works tile by tile. The part of an image that a tile sees is copied so that the scores of a
    pixel lie together, and those of all classes are interpolated at once. Labels of owners are
    complete with one image: their scores are compared as they are interpolated.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(n, K, h, w)`` float32, h and w at least 2.
        sight: Geometry of these images and the canvas.
        softmax: Whether scores become probabilities after they are interpolated; not feathered.
        total: ``(H, W, K + 1)`` weighted sums, and the sum of the weights, changed. Empty where
            only labels are wanted, for which all images of a pixel have to come at once.
        labels: ``(H, W)`` best classes, written where `total` is empty.
    """
    num_classes = scores.shape[1]
    side = scores.shape[2], scores.shape[3]
    at_once = len(sight.owner) > 0 and len(total) == 0
    lanes = (num_classes // _LANES + 1) * _LANES
    owns = np.empty(_count(sight), np.bool_)
    u, v, weight = np.empty((3, _TILE**2))
    seen = _Seen(np.empty(_TILE**2, np.int64), u, v, weight)
    column, row = np.empty((2, _TILE**2), np.int32)
    right, below = np.empty((2, _TILE**2), np.float32)
    corner = np.empty(_TILE**2, np.uint64)
    sums = np.empty((_TILE**2, lanes), np.float32)
    patch = np.empty(0, np.float32)
    bottom = start
    while bottom < stop:
        top = bottom
        height, across = _tile_size(abs(sight.rows[top, 0]))
        bottom = min(stop, top + height)
        for left in range(0, len(sight.columns), across):
            tile = top, bottom, left, min(len(sight.columns), left + across)
            step = tile[3] - left, -top * (tile[3] - left) - left
            if at_once:
                step = len(sight.columns), 0
            else:
                sums[:] = 0
            _mark_owners(tile, sight.owner, owns)
            for m in range(len(scores)):
                if not owns[sight.images[m]]:
                    continue
                n = _list_pixels(tile, m, side, sight, step, seen)
                if n == 0:
                    continue
                first, last = _split(u[:n], side[1], column, right)
                upper, lower = _split(v[:n], side[0], row, below)
                wide, high = last - first + 2, lower - upper + 2
                if len(patch) < high * wide * lanes:
                    patch = np.empty(high * wide * lanes, np.float32)
                _copy_patch(scores[m], first, upper, high, wide, lanes, patch)
                _find_corners(row[:n], upper, column, first, wide, lanes, corner)
                if at_once:
                    _label_patch(
                        patch, corner[:n], np.uint64(wide * lanes), np.uint64(lanes),
                        right, below, np.uint64(num_classes), seen.pixel, labels.reshape(-1),
                    )  # fmt: skip
                else:
                    _add_patch(
                        patch, corner[:n], np.uint64(wide * lanes), np.uint64(lanes),
                        right, below, weight, seen.pixel, sums.reshape(-1),
                    )  # fmt: skip
            if not at_once:
                _finish(tile, num_classes, softmax, sums, total, labels)


@njit_exact
def best_classes(start: int, stop: int, total: Array, min_confidence: float, labels: Array) -> None:
    """Best class of the ``(H, W, K + 1)`` totals of `add_images`, rows ``start:stop``.

    K where its probability is below `min_confidence`.
    """
    count = total.shape[2] - 1
    for i in range(start, stop):
        for j in range(labels.shape[1]):
            best = _best_class(total[i, j], count)
            unsure = total[i, j, best] < min_confidence * total[i, j, count]
            labels[i, j] = count if unsure else best


@njit_exact
def seen_table(
    start: int, stop: int, side: tuple[int, int], sight: Sight,
    count: Array, face: Array, u: Array, v: Array, weight: Array,
) -> None:  # fmt: skip
    """All images that contribute to a pixel, for the rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        side: Rows and columns of the images.
        sight: Geometry of images and canvas.
        count: ``(H, W)`` how many images there are, 0 before, written.
        face: ``(R, H, W)`` images, written; with R = 0 they are only counted.
        u: ``(R, H, W)`` columns in the images, written.
        v: ``(R, H, W)`` rows in the images, written.
        weight: ``(R, H, W)`` weights, written.
    """
    width = len(sight.columns)
    owns = np.empty(_count(sight), np.bool_)
    line_u, line_v, line_w = np.empty((3, width))
    seen = _Seen(np.empty(width + 1, np.int32), line_u, line_v, line_w)
    for i in range(start, stop):
        tile = i, i + 1, 0, width
        _mark_owners(tile, sight.owner, owns)
        for m in range(len(sight.matrices)):
            if not owns[sight.images[m]]:
                continue
            for p in range(_list_pixels(tile, m, side, sight, (0, 0), seen)):
                j = seen.pixel[p]
                rank = count[i, j]
                count[i, j] += 1
                if rank < len(face):
                    face[rank, i, j], weight[rank, i, j] = m, line_w[p]
                    u[rank, i, j], v[rank, i, j] = line_u[p], line_v[p]
