"""Compiled loops that add images to a canvas.

A *canvas* is what images are put together on: a panorama, or a photo made of crops. Its pixels
look along `sampling.Rays`. An image sees a ray at its pixel (u, v) where ``(u, v, 1)`` is
proportional to its ``(3, 3)`` matrix times the ray, if the third number is positive.

Sums are arrays ``(H, W, Kp)``: the scores of a pixel lie beside each other, K of them and zeros up
to a multiple of `LANES`, which compiles to vector code without a rest.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_exact, njit_fast

LANES = 16
"""The number of scores of a pixel is a multiple of this."""

_TILE_SCORES = 2**18
"""Sums of what is added to at once: they stay in the cache."""

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_LN_2, _LOG2_E = np.float32(math.log(2)), np.float32(1 / math.log(2))
_C3, _C4, _C5, _C6 = np.float32(1 / 6), np.float32(1 / 24), np.float32(1 / 120), np.float32(1 / 720)
_FLUSHED = np.float32(-40)

Array = NDArray[Any]
Tile = tuple[int, int, int, int]
"""First row and the one after the last, first column and the one after the last."""


class CanvasGeometry(NamedTuple):
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


class _TileBuffers(NamedTuple):
    """Buffers for the pixels of a tile that an image contributes to, and for runs of neighbors.

    Attributes:
        pixel: Where results of a pixel go.
        u: Its column in the image.
        v: Its row in the image.
        weight: Its weight.
        column: Whole part of the column.
        row: Whole part of the row.
        right: Rest of the column.
        below: Rest of the row.
        runs: ``(n, 4)`` image, row of the canvas, first column and the one after the last.
    """

    pixel: Array
    u: Array
    v: Array
    weight: Array
    column: Array
    row: Array
    right: Array
    below: Array
    runs: Array


class _Taps(NamedTuple):
    """The four pixels of a patch around every position, and their weights.

    Attributes:
        first: Place of the upper left one.
        a: Weights of the upper left one.
        b: Of the upper right one.
        c: Of the lower left one.
        d: Of the lower right one.
    """

    first: Array
    a: Array
    b: Array
    c: Array
    d: Array


@njit_fast
def _project(
    m: Array, row: Array, columns: Array, start: int, stop: int, u: Array, v: Array
) -> None:
    """Project neighbors in a row of the canvas into an image; u is infinite where it looks away.

    Args:
        m: ``(3, 3)`` from rays to homogeneous pixels.
        row: ``(2,)`` factors of the row.
        columns: ``(2, W)`` factors of the columns.
        start: First column.
        stop: One past the last column.
        u: ``(n,)`` columns in the image, written.
        v: ``(n,)`` rows in the image, written.
    """
    ux, uy, uz = row[0] * m[0, 0], row[0] * m[0, 1], row[1] * m[0, 2]
    vx, vy, vz = row[0] * m[1, 0], row[0] * m[1, 1], row[1] * m[1, 2]
    wx, wy, wz = row[0] * m[2, 0], row[0] * m[2, 1], row[1] * m[2, 2]
    xs, ys = columns[0, start:stop], columns[1, start:stop]
    for p in range(len(xs)):
        x, y = xs[p], ys[p]
        near = 1 / (wx * x + wy * y + wz)
        u[p] = (ux * x + uy * y + uz) * near if near > 0 else np.inf
        v[p] = (vx * x + vy * y + vz) * near


@njit_fast
def _feather(side: tuple[int, int], u: Array, v: Array, weight: Array) -> int:
    """Write feather weights, 0 outside the image; returns how many are."""
    per_column, per_row, outside = 2 / side[1], 2 / side[0], 0
    for p in range(len(weight)):
        a, b = (u[p] + 0.5) * per_column - 1, (v[p] + 0.5) * per_row - 1
        weight[p] = math.sqrt(max(1 - a * a, 0.0) * max(1 - b * b, 0.0))
        outside += 0 if weight[p] > 0 else 1
    return outside


@njit_fast
def _tile_buffers(pixels: int) -> _TileBuffers:
    """Buffers for a tile; one array each, as numba takes the parts of a common one for strided."""
    u, v, weight = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    column, row = np.empty(pixels, np.int32), np.empty(pixels, np.int32)
    right, below = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    pixel, runs = np.empty(pixels, np.int64), np.empty((pixels, 4), np.int32)
    return _TileBuffers(pixel, u, v, weight, column, row, right, below, runs)


@njit_fast
def _tap_buffers(pixels: int) -> _Taps:
    """Buffers for the taps of a tile."""
    a, b = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    c, d = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    return _Taps(np.empty(pixels, np.int32), a, b, c, d)


@njit_fast
def _enough(buffers: Array, size: int) -> Array:
    """A flat array, or a new one of zeros if it is too small."""
    return buffers if len(buffers) >= size else np.zeros(size, buffers.dtype)


@njit_fast
def _count(canvas: CanvasGeometry) -> int:
    """One more than the greatest number of an image."""
    greatest = canvas.images.max()
    return max(greatest, canvas.owner.max()) + 1 if len(canvas.owner) else greatest + 1


@njit_fast
def _owned_runs(tile: Tile, owner: Array, runs: Array, owns: Array) -> int:
    """Find neighbors in the rows of a tile that one image owns; returns how many runs there are.

    Args:
        tile: The tile.
        owner: ``(H, W)``.
        runs: ``(n, 4)`` image, row, first column and the one after the last, written.
        owns: Whether an image owns a pixel, written.
    """
    top, bottom, left, right = tile
    owns[:] = False
    count = 0
    for i in range(top, bottom):
        line, start = owner[i], left
        for j in range(left + 1, right + 1):
            if j == right or line[j] != line[start]:
                owns[line[start]] = True
                runs[count, 0], runs[count, 1] = line[start], i
                runs[count, 2], runs[count, 3] = start, j
                count, start = count + 1, j
    return count


@njit_fast
def _seen_runs(tile: Tile, m: int, canvas: CanvasGeometry, runs: Array) -> int:
    """See `_owned_runs`, of pixels of which image m may see something."""
    top, bottom, left, right = tile
    width, count = canvas.columns.shape[1], 0
    for i in range(top, bottom):
        begin, span = canvas.spans[m, i, 0], canvas.spans[m, i, 1]
        for back in range(0, width + 1, width):
            start, stop = max(left, begin - back), min(right, begin + span - back)
            if start < stop:
                runs[count, 0], runs[count, 1] = canvas.images[m], i
                runs[count, 2], runs[count, 3] = start, stop
                count += 1
    return count


@njit_fast
def _list_pixels(
    m: int,
    side: tuple[int, int],
    canvas: CanvasGeometry,
    found: int,
    step: tuple[int, int],
    buffers: _TileBuffers,
) -> int:
    """List the pixels of runs that image m contributes to; returns how many.

    Args:
        m: Index of the image in `canvas`.
        side: Rows and columns of the image.
        canvas: Geometry of images and canvas.
        found: Number of runs, of any images.
        step: From a row to the next one where results go, and there the place of pixel (0, 0).
        buffers: Holds the runs; pixels, columns, rows and weights are written.
    """
    pixel, u, v, weight = buffers.pixel, buffers.u, buffers.v, buffers.weight
    count = 0
    for n in range(found):
        image, i, start, stop = buffers.runs[n]
        if image != canvas.images[m]:
            continue
        first, count = count, count + stop - start
        row = canvas.rows[i]
        _project(canvas.matrices[m], row, canvas.columns, start, stop, u[first:], v[first:])
        pixels, weights = pixel[first:count], weight[first:count]
        for p in range(len(pixels)):
            pixels[p], weights[p] = i * step[0] + step[1] + start + p, 1
        if len(canvas.owner) == 0 and _feather(side, u[first:], v[first:], weights) > 0:
            last, count = count, first
            for p in range(first, last):
                if weight[p] > 0:
                    u[count], v[count], weight[count] = u[p], v[p], weight[p]
                    pixel[count] = pixel[p]
                    count += 1
    return count


@njit_fast
def _split_axis(places: Array, count: int, whole: Array, rest: Array) -> tuple[int, int]:
    """Split positions on an axis of `count` pixels, clamped to it, for interpolation.

    Args:
        places: ``(n,)``.
        count: Pixels of the axis.
        whole: ``(n,)`` the first of the two pixels around a position, written.
        rest: ``(n,)`` share of the second, 0 to 1, written.

    Returns:
        The first pixel, and how many there are up to the last.
    """
    least, greatest = np.int32(count), np.int32(0)
    for p in range(len(places)):
        place = min(max(places[p], 0.0), count - 1.0)
        first = min(np.int32(place), np.int32(count - 2))
        whole[p], rest[p] = first, place - first
        least, greatest = min(least, first), max(greatest, first)
    return int(least), int(greatest) - int(least) + 2


@njit_fast
def _split(n: int, side: tuple[int, int], buffers: _TileBuffers) -> tuple[int, int, int, int]:
    """Split the columns and rows of n pixels; returns first row, first column, rows, columns."""
    left, wide = _split_axis(buffers.u[:n], side[1], buffers.column, buffers.right)
    top, high = _split_axis(buffers.v[:n], side[0], buffers.row, buffers.below)
    return top, left, high, wide


@njit_fast
def _weigh(n: int, step: tuple[int, int], buffers: _TileBuffers, taps: _Taps) -> None:
    """Write the taps of n pixels.

    Args:
        n: Number of pixels.
        step: Places from a row to the next one, and the place of pixel (0, 0) of the image.
        buffers: Columns, rows and weights of the pixels.
        taps: Written.
    """
    first, a, b, c, d = taps
    for p in range(n):
        first[p] = buffers.row[p] * step[0] + buffers.column[p] + step[1]
        lower = np.float32(buffers.weight[p]) * buffers.below[p]
        upper = np.float32(buffers.weight[p]) - lower
        b[p], d[p] = buffers.right[p] * upper, buffers.right[p] * lower
        a[p], c[p] = upper - b[p], lower - d[p]


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
    """Softmax over the classes, in place, but for a factor.

    Args:
        lines: ``(K, n)`` scores, changed; NaN gets a probability of 0.
        highest: ``(n,)`` buffer.
        factor: ``(n,)`` factors that make the sums 1, written.
    """
    pixels = np.uint64(len(factor))
    highest[:], factor[:] = -np.inf, 0
    for k in range(len(lines)):
        line = lines[k]
        for x in range(pixels):
            highest[x] = line[x] if line[x] > highest[x] else highest[x]
    for k in range(len(lines)):
        line = lines[k]
        for x in range(pixels):
            line[x] = _exp(line[x] - highest[x])
            factor[x] += line[x]
    for x in range(pixels):
        factor[x] = _ONE / factor[x] if factor[x] > 0 else _ZERO


@njit_fast
def _copy_patch(scores: Array, left: int, top: int, softmax: bool, patch: Array) -> None:
    """Copy a part of the ``(K, h, w)`` scores of an image, scores of a pixel beside each other.

    Args:
        scores: Of the image.
        left: First column of the part.
        top: First row of the part.
        softmax: Whether to copy probabilities.
        patch: ``(height, width, Kp)``, written but for the zeros at the end of each pixel.
    """
    num_classes, width = len(scores), patch.shape[1]
    lines = np.empty((num_classes, width), np.float32)
    highest, factor = np.empty(width, np.float32), np.ones(width, np.float32)
    for y in range(len(patch)):
        pixels = patch[y]
        for k in range(num_classes):
            line, there = lines[k], scores[k, top + y]
            for x in range(np.uint64(width)):
                line[x] = there[np.uint64(left) + x]
        if softmax:
            _softmax_lines(lines, highest, factor)
        for k in range(np.uint64(num_classes)):
            for x in range(np.uint64(width)):
                pixels[x, k] = lines[k, x] * factor[x]


@njit_fast
def _add_samples(
    patch: Array, width: int, blocks: int, taps: _Taps, pixel: Array, sums: Array
) -> None:
    """Add weighted bilinear samples of a patch to sums.

    Args:
        patch: Scores of a part of an image, flat.
        width: Pixels in a row of it.
        blocks: ``Kp / LANES``: the compiler has to know that there is no rest.
        taps: Of n pixels.
        pixel: ``(n,)`` where their sums are.
        sums: ``(h, w, Kp)``, flat, changed.
    """
    classes = np.uint64(LANES) * np.uint64(blocks)
    below = classes * np.uint64(width)
    for p in range(len(pixel)):
        at, to = classes * np.uint64(taps.first[p]), classes * np.uint64(pixel[p])
        a, b, c, d = taps.a[p], taps.b[p], taps.c[p], taps.d[p]
        for k in range(classes):
            upper = a * patch[at + k] + b * patch[at + classes + k]
            lower = c * patch[at + below + k] + d * patch[at + below + classes + k]
            sums[to + k] += upper + lower


@njit_fast
def _add_probabilities(
    tile: Tile, covered: Array, owner: Array, num_classes: int, sums: Array, total: Array
) -> None:
    """Add the softmax of a tile's scores to the totals.

    Args:
        tile: The tile.
        covered: Whether an image is among those that were added.
        owner: ``(H, W)``.
        num_classes: K.
        sums: ``(height, width, Kp)`` scores of the tile.
        total: ``(H, W, Kp)``, changed.
    """
    top, bottom, left, right = tile
    width = right - left
    lines = np.empty((num_classes, width), np.float32)
    highest, factor = np.empty(width, np.float32), np.empty(width, np.float32)
    for i in range(top, bottom):
        for k in range(np.uint64(num_classes)):
            for x in range(np.uint64(width)):
                lines[k, x] = sums[i - top, x, k]
        _softmax_lines(lines, highest, factor)
        for x in range(width):
            if not covered[owner[i, left + x]]:
                factor[x] = 0
        pixels = total[i, left:right]
        for k in range(np.uint64(num_classes)):
            for x in range(np.uint64(width)):
                pixels[x, k] += lines[k, x] * factor[x]


@njit_fast
def _tiles(start: int, stop: int, canvas: CanvasGeometry, pixels: int) -> list[Tile]:
    """Tiles of `pixels` or fewer, about square on the sphere, that cover rows ``start:stop``."""
    tiles, bottom, width = [], start, canvas.columns.shape[1]
    while bottom < stop:
        top, remaining = bottom, stop - bottom
        parts = round(remaining / math.sqrt(pixels * abs(canvas.rows[top, 0])))
        rows = -(-remaining // max(1, parts))
        bottom, across = top + rows, pixels // rows
        for first in range(0, width, across):
            tiles.append((top, bottom, first, min(width, first + across)))  # noqa: PERF401
    return tiles


@njit_fast
def _write_classes(sums: Array, num_classes: int, least: float, labels: Array) -> None:
    """Write classes of the largest sums of the pixels of a row: of equal ones the first, never NaN.

    Args:
        sums: ``(w, Kp)``.
        num_classes: K.
        least: Share of the sum of all classes that the largest must have, else the class is K.
        labels: ``(w,)``, written.
    """
    for x in range(len(labels)):
        highest, best = np.float32(-np.inf), np.int32(0)
        for k in range(np.uint64(num_classes)):
            score = sums[x, k]
            # A sum, not a choice: that would be compiled to a branch, slow where classes change.
            best += (np.int32(k) - best) * np.int32(score > highest)
            highest = score if score > highest else highest
        unsure = least > 0 and highest < least * sums[x, :num_classes].sum()
        labels[x] = num_classes if unsure else best


@njit_fast
def _add_to_tile(
    tile: Tile, scores: Array, canvas: CanvasGeometry, softmax: bool, step: tuple[int, int],
    owns: Array, buffers: _TileBuffers, taps: _Taps, patch: Array, sums: Array,
) -> Array:  # fmt: skip
    """Add weighted scores of images to the sums of a tile.

    Args:
        tile: The tile.
        scores: ``(n, K, h, w)``.
        canvas: Geometry of the images and the canvas.
        softmax: Whether to add probabilities.
        step: See `_list_pixels`.
        owns: Buffer for all images, true at first.
        buffers: Buffers for the tile's pixels.
        taps: Buffers for the taps.
        patch: Buffer for a part of an image.
        sums: ``(h, w, Kp)``, changed.

    Returns:
        The buffer for a part of an image, or a larger one.
    """
    side, classes, found = (scores.shape[2], scores.shape[3]), sums.shape[2], 0
    owned = len(canvas.owner) > 0
    if owned:
        found = _owned_runs(tile, canvas.owner, buffers.runs, owns)
    for m in range(len(scores)):
        if not owns[canvas.images[m]]:
            continue
        if not owned:
            found = _seen_runs(tile, m, canvas, buffers.runs)
        n = _list_pixels(m, side, canvas, found, step, buffers)
        if n == 0:
            continue
        top, left, high, wide = _split(n, side, buffers)
        _weigh(n, (wide, -top * wide - left), buffers, taps)
        size = high * wide * classes
        patch = _enough(patch, size)
        part, blocks = patch[:size], classes // LANES
        _copy_patch(scores[m], left, top, softmax, part.reshape((high, wide, classes)))
        _add_samples(part, wide, blocks, taps, buffers.pixel[:n], sums.reshape(-1))
    return patch


@njit_fast
def add_images(
    start: int,
    stop: int,
    scores: Array,
    canvas: CanvasGeometry,
    softmax: bool,
    total: Array,
    labels: Array,
) -> None:
    """Add weighted scores of images to rows ``start:stop`` of a canvas, or write best classes.

    Works tile by tile: the part of an image that a tile sees is copied.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(n, K, h, w)`` float32, h and w at least 2.
        canvas: Geometry of these images and the canvas.
        softmax: Whether to add probabilities: those of owners are of the interpolated scores,
            feathered ones are interpolated.
        total: ``(H, W, Kp)`` sums, changed. Empty where only labels are wanted, for which all
            images of a pixel have to come at once.
        labels: ``(H, W)`` classes of the largest sums, written where `total` is empty.
    """
    num_classes, width = scores.shape[1], canvas.columns.shape[1]
    classes, afterwards = -(-num_classes // LANES) * LANES, softmax and len(canvas.owner) > 0
    owns, covered = np.ones(_count(canvas), np.bool_), np.zeros(_count(canvas), np.bool_)
    for image in canvas.images:
        covered[image] = True
    pixels = max(64, _TILE_SCORES // classes)
    buffers, taps, patch = _tile_buffers(pixels), _tap_buffers(pixels), np.empty(0, np.float32)
    of_tile = np.empty(0, np.float32)
    for tile in _tiles(start, stop, canvas, pixels):
        top, bottom, left, right = tile
        sums, step = total, (width, 0)
        if afterwards or len(total) == 0:
            high, wide = bottom - top, right - left
            of_tile = _enough(of_tile, pixels * classes)
            sums = of_tile[: high * wide * classes].reshape((high, wide, classes))
            sums[:] = 0
            step = wide, -top * wide - left
        before = softmax and not afterwards
        patch = _add_to_tile(tile, scores, canvas, before, step, owns, buffers, taps, patch, sums)
        if len(total) == 0:
            for i in range(top, bottom):
                _write_classes(sums[i - top], num_classes, 0.0, labels[i, left:right])
        elif afterwards:
            _add_probabilities(tile, covered, canvas.owner, num_classes, sums, total)


@njit_fast
def _best_of_part(scores: Array, left: int, top: int, highest: Array, best: Array) -> None:
    """Best classes of a part of the ``(K, h, w)`` scores of an image.

    Args:
        scores: Of the image.
        left: First column of the part.
        top: First row of the part.
        highest: ``(width,)`` buffer.
        best: ``(height, width)``, written; −1 where no score is finite and the largest.
    """
    width = best.shape[1]
    for y in range(len(best)):
        highest[:], of_row = -np.inf, best[y]
        of_row[:] = 0
        # Two classes at once, of an odd number the last one twice: half as much is written.
        for k in range(0, len(scores), 2):
            after = min(k + 1, len(scores) - 1)
            first, second = scores[k, top + y], scores[after, top + y]
            for x in range(np.uint64(width)):
                score, other = first[np.uint64(left) + x], second[np.uint64(left) + x]
                better = score > highest[x]
                label = np.int32(k) if better else of_row[x]
                most = score if better else highest[x]
                of_row[x] = np.int32(after) if other > most else label
                highest[x] = other if other > most else most
        for x in range(np.uint64(width)):
            finite = -np.inf < highest[x] < np.inf
            of_row[x] = of_row[x] if finite else -1


@njit_fast
def _interpolated_classes(
    scores: Array, count: int, taps: _Taps, highest: Array, best: Array
) -> None:
    """Classes of the largest interpolated scores: of equal ones the first, and never NaN.

    Args:
        scores: ``(K, h, w)`` of an image.
        count: Number of pixels n.
        taps: Of the pixels, in the image.
        highest: Buffer.
        best: Of the pixels, written.
    """
    right, below = np.uint64(1), np.uint64(scores.shape[2])
    highest[:count], best[:count] = -np.inf, 0
    for k in range(len(scores)):
        plane, label = scores[k].reshape(-1), np.int32(k)
        for p in range(np.uint64(count)):
            at = np.uint64(taps.first[p])
            score = taps.a[p] * plane[at] + taps.b[p] * plane[at + right]
            score += taps.c[p] * plane[at + below] + taps.d[p] * plane[at + below + right]
            better = score > highest[p]
            best[p] = label if better else best[p]
            highest[p] = score if better else highest[p]


@njit_fast
def _write_alike(
    n: int, best: Array, corner: tuple[int, int], buffers: _TileBuffers, labels: Array
) -> int:
    """Write labels of pixels around which all four pixels of the image have the same best class.

    Args:
        n: How many pixels there are.
        best: From `_best_of_part`.
        corner: Row and column of the part in the image.
        buffers: The pixels; the others are moved to the front.
        labels: Flat, written.

    Returns:
        How many others there are.
    """
    flat, below = best.reshape(-1), np.uint64(best.shape[1])
    others, right = 0, np.uint64(1)
    for p in range(n):
        at = np.uint64((buffers.row[p] - corner[0]) * best.shape[1] + buffers.column[p] - corner[1])
        label = flat[at]
        if label == flat[at + right] == flat[at + below] == flat[at + below + right] >= 0:
            labels[buffers.pixel[p]] = label
            continue
        buffers.pixel[others] = buffers.pixel[p]
        buffers.column[others], buffers.row[others] = buffers.column[p], buffers.row[p]
        buffers.right[others], buffers.below[others] = buffers.right[p], buffers.below[p]
        others += 1
    return others


@njit_fast
def label_images(
    start: int, stop: int, scores: Array, canvas: CanvasGeometry, labels: Array
) -> None:
    """Write the best classes of the pixels that images own, in rows ``start:stop`` of a canvas.

    Where the four pixels of an image around a position have the same best class, so has the
    interpolated score: others are not interpolated.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(n, K, h, w)`` float32, h and w at least 2.
        canvas: Geometry of these images and the canvas, with owners.
        labels: ``(H, W)``, written.
    """
    side, width, pixels = (scores.shape[2], scores.shape[3]), labels.shape[1], _TILE_SCORES // LANES
    buffers, taps, owns = (
        _tile_buffers(pixels),
        _tap_buffers(pixels),
        np.empty(_count(canvas), np.bool_),
    )
    highest, unlike = np.empty(max(side[1], pixels), np.float32), np.empty(pixels, np.int32)
    best, flat = np.empty(0, np.int32), labels.reshape(-1)
    for tile in _tiles(start, stop, canvas, pixels):
        found = _owned_runs(tile, canvas.owner, buffers.runs, owns)
        for m in range(len(scores)):
            if not owns[canvas.images[m]]:
                continue
            n = _list_pixels(m, side, canvas, found, (width, 0), buffers)
            top, left, high, wide = _split(n, side, buffers)
            best = _enough(best, high * wide)
            part = best[: high * wide].reshape((high, wide))
            _best_of_part(scores[m], left, top, highest[:wide], part)
            n = _write_alike(n, part, (top, left), buffers, flat)
            _weigh(n, (side[1], 0), buffers, taps)
            _interpolated_classes(scores[m], n, taps, highest, unlike)
            for p in range(n):
                flat[buffers.pixel[p]] = unlike[p]


@njit_fast
def best_classes(
    start: int, stop: int, total: Array, num_classes: int, min_confidence: float, labels: Array
) -> None:
    """Classes of the largest totals of `add_images`, rows ``start:stop``; see `_write_classes`."""
    for i in range(start, stop):
        _write_classes(total[i], num_classes, min_confidence, labels[i])


@njit_exact
def seen_table(
    start: int, stop: int, side: tuple[int, int], canvas: CanvasGeometry,
    count: Array, face: Array, u: Array, v: Array, weight: Array,
) -> None:  # fmt: skip
    """All images that contribute to a pixel, for the rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        side: Rows and columns of the images.
        canvas: Geometry of images and canvas.
        count: ``(H, W)`` how many images there are, 0 before, written.
        face: ``(R, H, W)`` images, written; with R = 0 they are only counted.
        u: ``(R, H, W)`` columns in the images, written.
        v: ``(R, H, W)`` rows in the images, written.
        weight: ``(R, H, W)`` weights, written.
    """
    width = canvas.columns.shape[1]
    owned, owns = len(canvas.owner) > 0, np.ones(_count(canvas), np.bool_)
    buffers, found = _tile_buffers(width), 0
    for i in range(start, stop):
        tile = i, i + 1, 0, width
        if owned:
            found = _owned_runs(tile, canvas.owner, buffers.runs, owns)
        for m in range(len(canvas.matrices)):
            if not owns[canvas.images[m]]:
                continue
            if not owned:
                found = _seen_runs(tile, m, canvas, buffers.runs)
            for p in range(_list_pixels(m, side, canvas, found, (0, 0), buffers)):
                j = buffers.pixel[p]
                rank = count[i, j]
                count[i, j] += 1
                if rank < len(face):
                    face[rank, i, j], weight[rank, i, j] = m, buffers.weight[p]
                    u[rank, i, j], v[rank, i, j] = buffers.u[p], buffers.v[p]
