"""Compiled loops: positions on the sphere, owners of pixels, and adding images to a canvas.

A *canvas* is what images are put together on: a panorama, or a photo made of crops. Its pixel
(i, j) looks along the ray ``(rows[i, 0] columns[0, j], rows[i, 0] columns[1, j], rows[i, 1])``;
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
    "Sight",
    "add_images",
    "best_classes",
    "equirect_map",
    "owners",
    "plane_rays",
    "seen_table",
    "sphere_rays",
]

_TILE = 64
"""Rows and columns at the equator of what is added to at once: its sums stay in the cache."""

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_LN_2, _LOG2_E = np.float32(math.log(2)), np.float32(1 / math.log(2))
_C3, _C4, _C5, _C6 = np.float32(1 / 6), np.float32(1 / 24), np.float32(1 / 120), np.float32(1 / 720)
_FLUSHED = np.float32(-40)

Array = NDArray[Any]
Rays = tuple[Array, Array]
"""``(2, W)`` factors of the columns and ``(H, 2)`` factors of the rows, float64."""
Tile = tuple[int, int, int, int]
"""First row and the one after the last, first column and the one after the last."""


class Sight(NamedTuple):
    """Geometry of n images and a canvas of ``(H, W)`` pixels.

    Attributes:
        images: ``(n,)`` their numbers, as they stand in `owner`.
        matrices: ``(n, 3, 3)`` from rays to homogeneous pixels.
        spans: ``(n, H, 2)`` in every row the first column that may see something of an image, and
            how many may, across the seam. Not read where there are owners.
        columns: ``(2, W)`` factors of the rays.
        rows: ``(H, 2)`` factors of the rays.
        owner: ``(H, W)``: an image has weight 1 where it is the owner, else 0. Empty for feather
            weights √((1 − a²)(1 − b²)) at offsets a, b in half image sides.
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
    return np.stack([np.cos(lon), np.sin(lon)]), np.stack([np.cos(lat), np.sin(lat)], -1)


def plane_rays(shape: tuple[int, int]) -> Rays:
    """``(j, 1, i)`` of the pixels of an image: its homogeneous pixels in another order."""
    height, width = shape
    columns = np.stack([np.arange(width, dtype=np.float64), np.ones(width)])
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
        columns: ``(2, w)`` factors of the rays.
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
        for j in range(columns.shape[1]):
            a, b = rows[i, 0] * columns[0, j], rows[i, 0] * columns[1, j]
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
        for j in range(columns.shape[1]):
            x, y = rows[i, 0] * columns[0, j], rows[i, 0] * columns[1, j]
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
    side: tuple[int, int], m: Array, row: Array, columns: Array, start: int, stop: int,
    u: Array, v: Array, weight: Array,
) -> None:  # fmt: skip
    """Project neighbors in a row of the canvas into an image.

    Args:
        side: Rows and columns of the image.
        m: ``(3, 3)`` from rays to homogeneous pixels.
        row: ``(2,)`` factors of the row.
        columns: ``(2, W)`` factors of the columns.
        start: First column.
        stop: One past the last column.
        u: ``(n,)`` columns in the image, written.
        v: ``(n,)`` rows in the image, written.
        weight: ``(n,)`` feather weights, written.
    """
    ux, uy, uz = row[0] * m[0, 0], row[0] * m[0, 1], row[1] * m[0, 2]
    vx, vy, vz = row[0] * m[1, 0], row[0] * m[1, 1], row[1] * m[1, 2]
    wx, wy, wz = row[0] * m[2, 0], row[0] * m[2, 1], row[1] * m[2, 2]
    xs, ys = columns[0, start:stop], columns[1, start:stop]
    per_column, per_row = 2 / side[1], 2 / side[0]
    for p in range(len(xs)):
        x, y = xs[p], ys[p]
        near = 1 / (wx * x + wy * y + wz)
        across, down = (ux * x + uy * y + uz) * near, (vx * x + vy * y + vz) * near
        u[p], v[p] = across, down
        a, b = (across + 0.5) * per_column - 1, (down + 0.5) * per_row - 1
        inside = max(1 - a * a, 0.0) * max(1 - b * b, 0.0)
        weight[p] = math.sqrt(inside) if near > 0 else 0.0


@njit_fast
def _room(pixels: int) -> _Seen:
    """Room for a list; one array each, as numba takes the parts of a common one for strided."""
    u, v, weight = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    return _Seen(np.empty(pixels, np.int64), u, v, weight)


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
                side, sight.matrices[m], sight.rows[i], sight.columns, start, stop,
                u[count:], v[count:], weight[count:],
            )  # fmt: skip
            pixels, weights = pixel[count:], weight[count:]
            for p in range(stop - start):
                pixels[p], weights[p] = at + start + p, 1.0
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
        for back in range(0, columns.shape[1] + 1, columns.shape[1]):
            start, stop = max(left, begin - back), min(right, begin + span - back)
            if start >= stop:
                continue
            _project(
                side, sight.matrices[m], sight.rows[i], columns, start, stop,
                u[count:], v[count:], weight[count:],
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
def _exp(x: np.float32) -> np.float32:
    """Exponential of a number up to 0, relative error 3e-7; 0 below −40 and of NaN.

    2^n e^r with r between ± ln(2) / 2, where a Taylor polynomial is enough. Unlike `math.exp` it
    compiles to vector code, and gives no denormal numbers, with which arithmetic is slow.
    """
    n = np.int32(x * _LOG2_E - _HALF)
    r = x - np.float32(n) * _LN_2
    power = ((((_C6 * r + _C5) * r + _C4) * r + _C3) * r + _HALF) * r * r + r + _ONE
    scale = np.int32((n + np.int32(127)) << np.int32(23)).view(np.float32)
    return power * scale if x > _FLUSHED else _ZERO


@njit_fast
def _softmax_lines(lines: Array, highest: Array, factor: Array) -> None:
    """Softmax of ``(K, n)`` scores over the first axis, in place, but for a factor.

    Args:
        lines: The scores, changed; NaN gets a probability of 0.
        highest: Room for n numbers.
        factor: ``(n,)`` factors that make the sums 1, written.
    """
    highest[:], factor[:] = -np.inf, 0
    count = np.uint64(lines.shape[1])
    for k in range(len(lines)):
        line = lines[k]
        for x in range(count):
            highest[x] = line[x] if line[x] > highest[x] else highest[x]
    for k in range(len(lines)):
        line = lines[k]
        for x in range(count):
            line[x] = _exp(line[x] - highest[x])
            factor[x] += line[x]
    for x in range(count):
        factor[x] = _ONE / factor[x] if factor[x] > 0 else _ZERO


@njit_fast
def _copy_patch(
    scores: Array, left: int, top: int, width: int, height: int, softmax: bool, patch: Array
) -> None:
    """Copy a part of ``(K, h, w)`` scores so that those of a pixel lie together."""
    num_classes = scores.shape[0]
    lines = np.empty((num_classes, width), np.float32)
    highest, factor = np.ones(width, np.float32), np.ones(width, np.float32)
    for y in range(height):
        for k in range(num_classes):
            line, there = lines[k], scores[k, top + y]
            for x in range(np.uint64(width)):
                line[x] = there[np.uint64(left) + x]
        if softmax:
            _softmax_lines(lines, highest, factor)
        pixels = patch[y * width * num_classes :]
        for x in range(np.uint64(width)):
            at = x * np.uint64(num_classes)
            for k in range(np.uint64(num_classes)):
                pixels[at + k] = lines[k, x] * factor[x]


@njit_fast
def _add_patch(
    patch: Array, num_classes: np.uint64, width: int, origin: int, column: Array, row: Array,
    right_share: Array, below_share: Array, weight: Array, pixel: Array, sums: Array,
) -> None:  # fmt: skip
    """Add weighted bilinear samples of a patch to sums.

    Unsigned indices spare numba's test for negative ones.

    Args:
        patch: Scores of an image's pixels, row by row.
        num_classes: K, scores of a pixel.
        width: Columns of the patch.
        origin: Place in the patch of pixel (0, 0) of the image.
        column: ``(n,)`` columns in the image.
        row: ``(n,)`` rows in the image.
        right_share: ``(n,)`` of the pixels to the right.
        below_share: ``(n,)`` of the pixels below.
        weight: ``(n,)``.
        pixel: ``(n,)`` where the sums are.
        sums: K for every pixel, changed.
    """
    for p in range(np.uint64(len(column))):
        a = np.uint64(row[p] * width + column[p] + origin) * num_classes
        b, c = a + num_classes, a + np.uint64(width) * num_classes
        d, to = c + num_classes, np.uint64(pixel[p]) * num_classes
        whole = np.float32(weight[p])
        lower = whole * below_share[p]
        upper = whole - lower
        wb, wd = right_share[p] * upper, right_share[p] * lower
        wa, wc = upper - wb, lower - wd
        for k in range(num_classes):
            sums[to + k] += (
                wa * patch[a + k] + wb * patch[b + k] + wc * patch[c + k] + wd * patch[d + k]
            )


@njit_fast
def _best_class(sums: Array) -> int:
    """Of the largest sum: the first of equal ones, and NaN never wins."""
    best, label = np.float32(-np.inf), 0
    for k in range(len(sums)):
        better = sums[k] > best
        best, label = (sums[k], k) if better else (best, label)
    return label


@njit_fast
def _finish(
    tile: Tile, covered: Array, sight: Sight, sums: Array, total: Array, labels: Array
) -> None:
    """Add the probabilities of a tile's pixels to the totals, or write their labels."""
    top, bottom, left, right = tile
    p = 0
    for i in range(top, bottom):
        for j in range(left, right):
            of_pixel = sums[p]
            p += 1
            if len(sight.owner) > 0 and not covered[sight.owner[i, j]]:
                continue
            if len(total) == 0:
                labels[i, j] = _best_class(of_pixel)
                continue
            highest = of_pixel[_best_class(of_pixel)]
            whole = np.float32(0)
            for k in range(len(of_pixel)):
                of_pixel[k] = _exp(of_pixel[k] - highest)
                whole += of_pixel[k]
            factor = _ONE / whole if whole > 0 else _ZERO
            for k in range(len(of_pixel)):
                total[i, j, k] += of_pixel[k] * factor


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
    pixel lie together, and those of all classes are interpolated at once.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(n, K, h, w)`` float32, h and w at least 2.
        sight: Geometry of these images and the canvas.
        softmax: Whether scores become probabilities: those of owners after they are interpolated,
            feathered ones before.
        total: ``(H, W, K)`` weighted sums, changed. Empty where only labels are wanted, for which
            all images of a pixel have to come at once.
        labels: ``(H, W)`` best classes, written where `total` is empty.
    """
    num_classes, side = scores.shape[1], (scores.shape[2], scores.shape[3])
    owned = len(sight.owner) > 0
    at_once = len(total) > 0 and not (owned and softmax)
    owns, covered = np.empty(_count(sight), np.bool_), np.zeros(_count(sight), np.bool_)
    for image in sight.images:
        covered[image] = True
    seen = _room(_TILE**2)
    column, row = np.empty(_TILE**2, np.int32), np.empty(_TILE**2, np.int32)
    right, below = np.empty(_TILE**2, np.float32), np.empty(_TILE**2, np.float32)
    sums = total.reshape(-1) if at_once else np.empty(_TILE**2 * num_classes, np.float32)
    patch = np.empty(0, np.float32)
    bottom = start
    while bottom < stop:
        top = bottom
        height, across = _tile_size(abs(sight.rows[top, 0]))
        bottom = min(stop, top + height)
        for left in range(0, sight.columns.shape[1], across):
            tile = top, bottom, left, min(sight.columns.shape[1], left + across)
            step = sight.columns.shape[1], 0
            if not at_once:
                sums[:] = 0
                step = tile[3] - left, -top * (tile[3] - left) - left
            _mark_owners(tile, sight.owner, owns)
            for m in range(len(scores)):
                if not owns[sight.images[m]]:
                    continue
                n = _list_pixels(tile, m, side, sight, step, seen)
                if n == 0:
                    continue
                first, last = _split(seen.u[:n], side[1], column, right)
                upper, lower = _split(seen.v[:n], side[0], row, below)
                wide, high = last - first + 2, lower - upper + 2
                if len(patch) < high * wide * num_classes:
                    patch = np.empty(high * wide * num_classes, np.float32)
                _copy_patch(scores[m], first, upper, wide, high, softmax and not owned, patch)
                _add_patch(
                    patch, np.uint64(num_classes), wide, -upper * wide - first,
                    column[:n], row, right, below, seen.weight, seen.pixel, sums,
                )  # fmt: skip
            if not at_once:
                _finish(tile, covered, sight, sums.reshape(-1, num_classes), total, labels)


@njit_fast
def best_classes(start: int, stop: int, total: Array, min_confidence: float, labels: Array) -> None:
    """Best class of the ``(H, W, K)`` totals of `add_images`, rows ``start:stop``.

    K where its probability is below `min_confidence`.
    """
    for i in range(start, stop):
        for j in range(labels.shape[1]):
            of_pixel = total[i, j]
            best, whole = _best_class(of_pixel), _ZERO
            for k in range(len(of_pixel)):
                whole += of_pixel[k]
            unsure = of_pixel[best] < min_confidence * whole
            labels[i, j] = len(of_pixel) if unsure else best


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
    width = sight.columns.shape[1]
    owns = np.empty(_count(sight), np.bool_)
    seen = _room(width)
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
                    face[rank, i, j], weight[rank, i, j] = m, seen.weight[p]
                    u[rank, i, j], v[rank, i, j] = seen.u[p], seen.v[p]
