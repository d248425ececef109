"""Loops compiled with numba, and those that add images to a canvas.

Compiled loops are serial and release the GIL; `over_rows` runs them on several threads. Numba's own
parallel loops are not used: its OpenMP layer kills worker processes forked after its first use, and
its portable layer crashes when two threads use it at once.

Numba caches compiled code by the source file of a loop, so a loop must not call compiled functions
of another file.

A *canvas* is the image on which other images are combined: a panorama, or a photo made of crops.
Its pixels have the rays of `tables.Rays`. A ``(3, 3)`` matrix of each image maps rays to its
homogeneous pixels, proportional to ``(u, v, 1)``; a ray is in front of the image if the third
number is positive.

Sums are arrays ``(H, W, Kp)``: the K scores of a pixel are adjacent in memory, followed by zeros up
to a multiple of `LANES`, so that loops over them compile to vector code without a remainder. Up to
`_FEW` channels, such as depth and its weight, have no zeros.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numba.core.compiler import Compiler
from numpy.typing import NDArray

_SMALLEST_SHARE = 2**15
"""Number of pixels from which another thread saves time."""

LANES = 16
_FEW = 4

_TILE_SCORES = 2**18
"""Number of sums in a tile: they fit into the processor's cache."""

_CANDIDATES = 8
"""Numbers that views may vote for at a pixel, at most; further ones do not count."""

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_LN_2, _LOG2_E = np.float32(math.log(2)), np.float32(1 / math.log(2))
_C3, _C4, _C5, _C6 = np.float32(1 / 6), np.float32(1 / 24), np.float32(1 / 120), np.float32(1 / 720)
_FLUSHED = np.float32(-40)
_NEVER = np.float32(-1e30)
"""Stands for a score of minus infinity, whose product with a weight of 0 would be NaN."""
_LOWEST = np.float32(-1e20)
"""Scores below it are weighted sums with `_NEVER`."""

Array = NDArray[Any]
Tile = tuple[int, int, int, int]
"""First row and the one after the last, first column and the one after the last."""


NO_OWNERS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)
NO_SPANS: NDArray[np.int32] = np.empty((0, 0, 2), np.int32)


class _Restrict(Compiler):  # type: ignore[misc]
    """A compiler that assumes, like ``restrict`` in C, that arguments do not overlap in memory.

    Otherwise a loop over the scores of one pixel spends more time on checking than on adding.
    """

    def define_pipelines(self) -> list[Any]:
        self.state.flags.noalias = True
        return super().define_pipelines()


njit_exact: Any = partial(njit, nogil=True, cache=True, error_model="numpy")
"""Compiles with IEEE arithmetic."""

njit_fast: Any = partial(
    njit_exact, fastmath={"contract", "reassoc", "nsz", "arcp"}, pipeline_class=_Restrict
)
"""Compiles with reordered arithmetic; infinities and NaN keep their meaning.

Arrays that the function writes must not overlap its other arguments.
"""


def over_rows(kernel: Callable[..., None], rows: int, width: int, *arguments: Any) -> None:
    """Run ``kernel(start, stop, *arguments)`` on blocks of rows, in parallel.

    Uses as many threads as torch (`torch.get_num_threads`, which is 1 in a `DataLoader` worker),
    and no threads for small images. The threads end with the call, so that processes may fork
    before and after it.

    Args:
        kernel: A compiled function that releases the GIL.
        rows: Number of rows.
        width: Pixels in a row.
        *arguments: Other arguments of the kernel.
    """
    threads = min(num_threads(), rows, rows * width // _SMALLEST_SHARE)
    if threads <= 1:
        kernel(0, rows, *arguments)
        return
    # Several blocks per thread, because rows near the poles do not take as long as others.
    blocks = min(8 * threads, rows)
    edges = [rows * block // blocks for block in range(blocks + 1)]
    with ThreadPoolExecutor(threads) as pool:
        runs = [pool.submit(kernel, start, stop, *arguments) for start, stop in pairwise(edges)]
        for run in runs:
            run.result()


def num_threads() -> int:
    """Return the number of threads of torch; before torch is imported, its default."""
    if "torch" in sys.modules:
        return int(sys.modules["torch"].get_num_threads())
    return int(os.environ.get("OMP_NUM_THREADS") or os.cpu_count() or 1)


class CanvasGeometry(NamedTuple):
    """Geometry of n images and a canvas of ``(H, W)`` pixels.

    Attributes:
        images: ``(n,)`` numbers of the images, as in `owner`.
        matrices: ``(n, 3, 3)`` from rays to homogeneous pixels.
        spans: ``(n, H, 2)`` first column that an image may cover in each row, and number of such
            columns, which may continue across the seam. Not used if there are owners.
        columns: ``(2, W)`` factors of the rays.
        rows: ``(H, 2)`` factors of the rays.
        owner: ``(H, W)`` owners: an image has weight 1 in the pixels it owns, else 0. Empty for
            feather weights √((1 − a²)(1 − b²)) at offsets a, b in half image sides.
    """

    images: Array
    matrices: Array
    spans: Array
    columns: Array
    rows: Array
    owner: Array


class _TileBuffers(NamedTuple):
    """Buffers for the pixels of a tile that an image contributes to, and for runs of pixels.

    Scores are interpolated between four pixels of the image with the weights a (upper left), b
    (upper right), c (lower left) and d (lower right).

    Attributes:
        pixel: Index at which the result of each pixel is stored.
        u: Column in the image.
        v: Row in the image.
        weight: Weight of the image.
        column: Integer part of the column.
        row: Integer part of the row.
        right: Fractional part of the column.
        below: Fractional part of the row.
        first: Index of the upper left pixel of the four.
        a: Weight of the upper left pixel.
        b: Weight of the upper right pixel.
        c: Weight of the lower left pixel.
        d: Weight of the lower right pixel.
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
    first: Array
    a: Array
    b: Array
    c: Array
    d: Array
    runs: Array


@njit_fast
def padded(channels: int) -> int:
    """Return the number Kp of numbers that are stored for some channels."""
    return channels if channels <= _FEW else -(-channels // LANES) * LANES


@njit_fast
def _project(
    m: Array, row: Array, columns: Array, start: int, stop: int, u: Array, v: Array
) -> None:
    """Project a run of pixels of the canvas into an image; u is infinite for rays behind it.

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
    """Write feather weights, 0 outside the image; return the number of pixels outside."""
    per_column, per_row, outside = 2 / side[1], 2 / side[0], 0
    for p in range(len(weight)):
        a, b = (u[p] + 0.5) * per_column - 1, (v[p] + 0.5) * per_row - 1
        weight[p] = math.sqrt(max(1 - a * a, 0.0) * max(1 - b * b, 0.0))
        outside += 0 if weight[p] > 0 else 1
    return outside


@njit_fast
def _tile_buffers(pixels: int) -> _TileBuffers:
    """Return buffers for a tile. Separate arrays: numba assumes strides for parts of one array."""
    u, v, weight = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    column, row = np.empty(pixels, np.int32), np.empty(pixels, np.int32)
    right, below = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    a, b = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    c, d = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    pixel, first = np.empty(pixels, np.int64), np.empty(pixels, np.int32)
    runs = np.empty((pixels, 4), np.int32)
    return _TileBuffers(pixel, u, v, weight, column, row, right, below, first, a, b, c, d, runs)


@njit_fast
def _at_least(buffer: Array, size: int) -> Array:
    """Return a flat buffer, or a larger one of zeros if it is too small."""
    return buffer if len(buffer) >= size else np.zeros(size, buffer.dtype)


@njit_fast
def _count(canvas: CanvasGeometry) -> int:
    """Return the largest number of an image plus 1."""
    greatest = canvas.images.max()
    return max(greatest, canvas.owner.max()) + 1 if len(canvas.owner) else greatest + 1


@njit_fast
def _owned_runs(tile: Tile, owner: Array, runs: Array, owns: Array) -> int:
    """Find runs of pixels in the rows of a tile that have one owner; return their number.

    Args:
        tile: The tile.
        owner: ``(H, W)`` owners.
        runs: ``(n, 4)`` image, row, first column and the one after the last, written.
        owns: True for each image that owns a pixel of the tile, written.
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
def _covered_runs(tile: Tile, m: int, canvas: CanvasGeometry, runs: Array) -> int:
    """Find runs of pixels of a tile that image m may cover; return their number."""
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
    num_runs: int,
    step: tuple[int, int],
    buffers: _TileBuffers,
) -> int:
    """List the pixels of runs that image m contributes to; return their number.

    Args:
        m: Index of the image in `canvas`.
        side: Rows and columns of the image.
        canvas: Geometry of images and canvas.
        num_runs: Number of runs, which may belong to several images.
        step: Where results are stored: distance between rows, and index of pixel (0, 0).
        buffers: Contains the runs; pixels, columns, rows and weights are written.
    """
    pixel, u, v, weight = buffers.pixel, buffers.u, buffers.v, buffers.weight
    count = 0
    for n in range(num_runs):
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
def _split_axis(positions: Array, count: int, first: Array, share: Array) -> tuple[int, int]:
    """Split positions on an axis into pixels and shares for linear interpolation.

    Args:
        positions: ``(n,)`` positions, clamped to the axis.
        count: Number of pixels of the axis.
        first: ``(n,)`` first of the two pixels around each position, written.
        share: ``(n,)`` share of the second pixel, 0 to 1, written.

    Returns:
        The first pixel that is needed, and the number of pixels up to the last one.
    """
    least, greatest = np.int32(count), np.int32(0)
    for p in range(len(positions)):
        position = min(max(positions[p], 0.0), count - 1.0)
        pixel = min(np.int32(position), np.int32(count - 2))
        first[p], share[p] = pixel, position - pixel
        least, greatest = min(least, pixel), max(greatest, pixel)
    return int(least), int(greatest) - int(least) + 2


@njit_fast
def _split(n: int, side: tuple[int, int], buffers: _TileBuffers) -> tuple[int, int, int, int]:
    """Split the positions of n pixels; return first row and column, number of rows and columns."""
    left, wide = _split_axis(buffers.u[:n], side[1], buffers.column, buffers.right)
    top, high = _split_axis(buffers.v[:n], side[0], buffers.row, buffers.below)
    return top, left, high, wide


@njit_fast
def _weigh(n: int, step: tuple[int, int], buffers: _TileBuffers) -> None:
    """Write the weights for the interpolation of n pixels.

    Args:
        n: Number of pixels.
        step: Distance between rows of the patch, and index of pixel (0, 0) of the image in it.
        buffers: Contains columns, rows and weights of the pixels; `first` and a to d are written.
    """
    for p in range(n):
        buffers.first[p] = buffers.row[p] * step[0] + buffers.column[p] + step[1]
        lower = np.float32(buffers.weight[p]) * buffers.below[p]
        upper = np.float32(buffers.weight[p]) - lower
        b, d = buffers.right[p] * upper, buffers.right[p] * lower
        buffers.a[p], buffers.b[p], buffers.c[p], buffers.d[p] = upper - b, b, lower - d, d


@njit_fast
def _exp(x: np.float32) -> np.float32:
    """Return e^x for x ≤ 0 with a relative error of 3e-7; 0 for NaN and below −40.

    Computed as 2^n e^r with r between ±ln(2)/2, where a Taylor polynomial is accurate. Unlike
    `math.exp` it compiles to vector code, and returns no denormal numbers, which are slow.
    """
    n = np.int32(x * _LOG2_E - _HALF)
    r = x - np.float32(n) * _LN_2
    power = ((((_C6 * r + _C5) * r + _C4) * r + _C3) * r + _HALF) * r * r + r + _ONE
    scale = np.int32((n + np.int32(127)) << np.int32(23)).view(np.float32)
    return power * scale if x > _FLUSHED else _ZERO


@njit_fast
def _softmax_lines(lines: Array, highest: Array, factor: Array) -> None:
    """Compute the softmax over the classes in place, except for a factor per pixel.

    Args:
        lines: ``(K, n)`` scores, changed.
        highest: ``(n,)`` buffer.
        factor: ``(n,)`` factors with which the probabilities add up to 1, written; NaN where a
            score is NaN or infinite, or all are minus infinity.
    """
    pixels = np.uint64(len(factor))
    highest[:], factor[:] = -np.inf, 0
    for k in range(len(lines)):
        line = lines[k]
        for x in range(pixels):
            highest[x] = line[x] if line[x] > highest[x] else highest[x]
            factor[x] += line[x]
    for x in range(pixels):
        highest[x] = highest[x] if factor[x] < np.inf and highest[x] > _LOWEST else np.nan
    factor[:] = 0
    for k in range(len(lines)):
        line = lines[k]
        for x in range(pixels):
            line[x] = _exp(line[x] - highest[x])
            factor[x] += line[x]
    for x in range(pixels):
        factor[x] = _ONE / factor[x] if factor[x] > 0 else np.nan


@njit_fast
def _bounded(score: np.float32) -> np.float32:
    """Return the score, or `_NEVER` for minus infinity."""
    return _NEVER if score < _NEVER else score


@njit_fast
def _copy_patch(scores: Array, left: int, top: int, softmax: bool, patch: Array) -> None:
    """Copy a part of an image's scores so that the scores of each pixel are adjacent.

    Args:
        scores: ``(K, h, w)`` scores of the image.
        left: First column of the part.
        top: First row of the part.
        softmax: True to copy probabilities.
        patch: ``(height, width, Kp)`` copy, written except for the zeros after each pixel's scores.
    """
    num_classes, width = len(scores), patch.shape[1]
    lines = np.empty((num_classes, width), np.float32)
    highest, factor = np.empty(width, np.float32), np.ones(width, np.float32)
    for y in range(len(patch)):
        pixels = patch[y]
        for k in range(num_classes):
            line, source = lines[k], scores[k, top + y]
            for x in range(np.uint64(width)):
                line[x] = _bounded(source[np.uint64(left) + x])
        if softmax:
            _softmax_lines(lines, highest, factor)
        for k in range(np.uint64(num_classes)):
            for x in range(np.uint64(width)):
                pixels[x, k] = lines[k, x] * factor[x]


@njit_fast
def _add_samples(
    n: int, patch: Array, width: int, classes: int, buffers: _TileBuffers, sums: Array
) -> None:
    """Add weighted bilinear samples of a patch to sums.

    Args:
        n: Number of pixels.
        patch: Scores of a part of an image, flat.
        width: Pixels in a row of the patch.
        classes: Kp.
        buffers: Contains the pixels and their weights.
        sums: ``(h, w, Kp)`` sums, flat, changed.
    """
    blocks = classes // LANES  # so that the compiler can rely on a multiple of `LANES`
    padded_classes = np.uint64(LANES) * np.uint64(blocks)
    for p in range(n):
        at, to = np.uint64(classes * buffers.first[p]), np.uint64(classes * buffers.pixel[p])
        right, below = at + np.uint64(classes), at + np.uint64(classes * width)
        diagonal = below + np.uint64(classes)
        a, b, c, d = buffers.a[p], buffers.b[p], buffers.c[p], buffers.d[p]
        if blocks == 0:
            for k in range(np.uint64(classes)):
                upper = a * patch[at + k] + b * patch[right + k]
                sums[to + k] += upper + c * patch[below + k] + d * patch[diagonal + k]
        else:
            for k in range(padded_classes):
                upper = a * patch[at + k] + b * patch[right + k]
                sums[to + k] += upper + c * patch[below + k] + d * patch[diagonal + k]


@njit_fast
def _add_probabilities(
    tile: Tile, covered: Array, owner: Array, num_classes: int, sums: Array, total: Array
) -> None:
    """Add the softmax of a tile's scores to the totals.

    Args:
        tile: The tile.
        covered: True for each image whose scores were added.
        owner: ``(H, W)`` owners.
        num_classes: K.
        sums: ``(height, width, Kp)`` scores of the tile.
        total: ``(H, W, Kp)`` totals, changed.
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
    """Return tiles that cover rows ``start:stop``, about square on the sphere.

    Args:
        start: First row.
        stop: One past the last row.
        canvas: Geometry of the canvas.
        pixels: Largest number of pixels of a tile.
    """
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
def _write_classes(
    sums: Array, num_classes: int, least: float, floor: float, labels: Array
) -> None:
    """Write the class of the largest sum of each pixel in a row; the first of equal ones.

    Args:
        sums: ``(w, Kp)`` sums.
        num_classes: K.
        least: Share of the sum of all classes that the largest must reach, else the class is K.
        floor: Number that the largest sum must exceed, else the class is K.
        labels: ``(w,)`` class indices, written; K where a sum is NaN or infinite.
    """
    for x in range(len(labels)):
        highest, best, total = np.float32(-np.inf), np.int32(0), _ZERO
        for k in range(np.uint64(num_classes)):
            score = sums[x, k]
            # Arithmetic, because a condition compiles to a branch, which is slow at class borders.
            best += (np.int32(k) - best) * np.int32(score > highest)
            highest = score if score > highest else highest
            total += score
        sure = highest > floor and total < np.inf and (least <= 0 or highest >= least * total)
        labels[x] = best if sure else num_classes


@njit_fast
def _add_to_tile(
    tile: Tile, scores: Array, canvas: CanvasGeometry, softmax: bool, step: tuple[int, int],
    owns: Array, buffers: _TileBuffers, patch: Array, sums: Array,
) -> Array:  # fmt: skip
    """Add weighted scores of images to the sums of a tile.

    Args:
        tile: The tile.
        scores: ``(n, K, h, w)`` scores of the images.
        canvas: Geometry of the images and the canvas.
        softmax: True to add probabilities.
        step: See `_list_pixels`.
        owns: Buffer for all images, True at first.
        buffers: Buffers for the tile's pixels.
        patch: Buffer for a part of an image.
        sums: ``(h, w, Kp)`` sums, changed.

    Returns:
        The buffer for a part of an image, or a larger one.
    """
    side, classes, num_runs = (scores.shape[2], scores.shape[3]), sums.shape[2], 0
    owned = len(canvas.owner) > 0
    if owned:
        num_runs = _owned_runs(tile, canvas.owner, buffers.runs, owns)
    for m in range(len(scores)):
        if not owns[canvas.images[m]]:
            continue
        if not owned:
            num_runs = _covered_runs(tile, m, canvas, buffers.runs)
        n = _list_pixels(m, side, canvas, num_runs, step, buffers)
        if n == 0:
            continue
        top, left, high, wide = _split(n, side, buffers)
        _weigh(n, (wide, -top * wide - left), buffers)
        size = high * wide * classes
        patch = _at_least(patch, size)
        _copy_patch(scores[m], left, top, softmax, patch[:size].reshape((high, wide, classes)))
        _add_samples(n, patch, wide, classes, buffers, sums.reshape(-1))
    return patch


@njit_fast
def _is_seen(owner: Array, covered: Array) -> bool:
    """Return True if an image for which `covered` is True owns a pixel."""
    for line in owner:
        for image in line:
            if covered[image]:
                return True
    return False


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

    Works tile by tile; the part of each image that the tile needs is copied first.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(n, K, h, w)`` float32, h and w at least 2.
        canvas: Geometry of these images and the canvas.
        softmax: True to add probabilities. With owners, scores are interpolated first; with
            feathering, probabilities are interpolated.
        total: ``(H, W, Kp)`` sums, changed. Empty to write only labels, of the pixels that these
            images own; without owners, all images have to be added in one call.
        labels: ``(H, W)`` classes of the largest sums, written if `total` is empty.
    """
    num_classes, width = scores.shape[1], canvas.columns.shape[1]
    classes, afterwards = padded(num_classes), softmax and len(canvas.owner) > 0
    owns, covered = np.ones(_count(canvas), np.bool_), np.zeros(_count(canvas), np.bool_)
    for image in canvas.images:
        covered[image] = True
    pixels = max(64, _TILE_SCORES // max(LANES, classes))
    buffers, patch = _tile_buffers(pixels), np.empty(0, np.float32)
    of_tile = np.empty(0, np.float32)
    found = np.empty(width, labels.dtype)
    for tile in _tiles(start, stop, canvas, pixels):
        top, bottom, left, right = tile
        if len(canvas.owner) > 0 and not _is_seen(canvas.owner[top:bottom, left:right], covered):
            continue
        sums, step = total, (width, 0)
        if afterwards or len(total) == 0:
            high, wide = bottom - top, right - left
            of_tile = _at_least(of_tile, pixels * classes)
            sums = of_tile[: high * wide * classes].reshape((high, wide, classes))
            sums[:] = 0
            step = wide, -top * wide - left
        before = softmax and not afterwards
        patch = _add_to_tile(tile, scores, canvas, before, step, owns, buffers, patch, sums)
        if len(total) == 0:
            for i in range(top, bottom):
                _write_classes(sums[i - top], num_classes, 0.0, _LOWEST, found[: right - left])
                for j in range(left, right):
                    if len(canvas.owner) == 0 or covered[canvas.owner[i, j]]:
                        labels[i, j] = found[j - left]
        elif afterwards:
            _add_probabilities(tile, covered, canvas.owner, num_classes, sums, total)


@njit_fast
def best_classes(
    start: int, stop: int, total: Array, num_classes: int, min_confidence: float, labels: Array
) -> None:
    """Write the classes of the largest totals in rows ``start:stop``, see `_write_classes`.

    Args:
        start: First row.
        stop: One past the last row.
        total: ``(H, W, Kp)`` totals of `add_images`.
        num_classes: K.
        min_confidence: Smallest share of the largest total, else the class is K. It is K too where
            no total is greater than 0.
        labels: ``(H, W)`` class indices, written.
    """
    for i in range(start, stop):
        _write_classes(total[i], num_classes, min_confidence, 0.0, labels[i])


@njit_fast
def vote(
    start: int, stop: int, numbers: Array, canvas: CanvasGeometry, factors: Array, winners: Array
) -> None:
    """Write the number with the largest sum of weights at every pixel of rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        numbers: ``(n, h, w)`` int32 numbers at the pixels of images; the nearest pixel votes.
        canvas: Geometry of the images and the canvas, with feather weights.
        factors: Factor of the weight of each number.
        winners: ``(H, W)`` int32, written; 0 where no image has a weight.
    """
    side, width = numbers.shape[1:], winners.shape[1]
    u, v, weight = np.empty(width), np.empty(width), np.empty(width)
    found = np.zeros((width, _CANDIDATES), np.int32)
    sums = np.zeros((width, _CANDIDATES), np.float32)
    for i in range(start, stop):
        sums[:] = 0
        for m in range(len(numbers)):
            begin, span = canvas.spans[m, i, 0], canvas.spans[m, i, 1]
            for back in range(0, width + 1, width):
                first, last = max(0, begin - back), min(width, begin + span - back)
                n = max(0, last - first)
                row = canvas.rows[i]
                _project(canvas.matrices[m], row, canvas.columns, first, first + n, u, v)
                _feather(side, u, v, weight[:n])
                for p in range(n):
                    if weight[p] <= 0:
                        continue
                    number = numbers[m, np.int64(v[p] + 0.5), np.int64(u[p] + 0.5)]
                    for c in range(_CANDIDATES):
                        if sums[first + p, c] == 0 or found[first + p, c] == number:
                            found[first + p, c] = number
                            sums[first + p, c] += np.float32(weight[p]) * factors[number]
                            break
        for j in range(width):
            best = np.argmax(sums[j])
            winners[i, j] = found[j, best] if sums[j, best] > 0 else 0
