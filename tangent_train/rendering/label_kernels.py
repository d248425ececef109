"""Compiled label rendering: the class of the largest score in the owner's image.

A panorama is rendered tile by tile, a tile image by image: the part of the image that its pixels
see is copied so that the classes of a pixel lie together, the scores of all classes are
interpolated at once, and those of `LANES` pixels are compared at once. Numba does not turn such
steps into vector code; they are written in LLVM's vector types, which any processor runs: with
AVX-512 a vector of floats is one register, elsewhere two or four.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_fast

__all__ = ["LANES", "owner_labels"]

LANES = 16
"""Classes interpolated and pixels compared at once, and the smallest side of an image."""

_TILE = (64, 64)
"""Rows and columns rendered at once, so that their scores stay in the cache."""

_INDEX, _WORD = ir.IntType(64), ir.IntType(32)
_FLOATS, _DOUBLES, _INTEGERS = (
    ir.VectorType(kind, LANES) for kind in (ir.FloatType(), ir.DoubleType(), _WORD)
)
_FUSED = ("contract",)


def _order(lanes: list[int]) -> ir.Constant:
    return ir.Constant(_INTEGERS, lanes)


def _all(vector: ir.VectorType, value: float) -> ir.Constant:
    return ir.Constant(vector, [value] * LANES)


def _spread(builder: Any, vector: ir.VectorType, value: Any) -> Any:
    """The same value in all lanes."""
    undefined = ir.Constant(vector, ir.Undefined)
    first = builder.insert_element(undefined, value, _WORD(0))
    return builder.shuffle_vector(first, undefined, _order([0] * LANES))


def _times_plus(builder: Any, factor: Any, other: Any, summand: Any) -> Any:
    product = builder.fmul(factor, other, flags=_FUSED)
    return builder.fadd(product, summand, flags=_FUSED)


def _data(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    return context.make_array(kind)(context, builder, array).data


def _address(builder: Any, data: Any, index: Any, vector: ir.VectorType = _FLOATS) -> Any:
    """Of the `LANES` numbers that start at an index."""
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _load(builder: Any, address: Any) -> Any:
    value = builder.load(address)
    value.align = 4
    return value


def _store(builder: Any, value: Any, address: Any) -> None:
    builder.store(value, address).align = 4


def _transpose(builder: Any, rows: list[Any]) -> None:
    """Transpose `LANES` vectors by exchanging, bit by bit, that bit of the row and of the lane."""
    for bit in (1 << b for b in range(LANES.bit_length() - 1)):
        even = _order([LANES + (i ^ bit) if i & bit else i for i in range(LANES)])
        odd = _order([LANES + i if i & bit else i | bit for i in range(LANES)])
        for i in range(LANES):
            if not i & bit:
                pair = rows[i], rows[i | bit]
                rows[i] = builder.shuffle_vector(*pair, even)
                rows[i | bit] = builder.shuffle_vector(*pair, odd)


@intrinsic  # type: ignore[untyped-decorator]
def _project(
    typing: Any,
    camera: Any,
    x: Any,
    y: Any,
    start: Any,
    last: Any,
    column: Any,
    row: Any,
    right: Any,
    below: Any,
    at: Any,
) -> Any:
    """Where an image sees `LANES` ERP pixels of one row, from the one at ``start``.

    Writes, from ``at`` on, the column and row of the first of the four pixels around the position,
    which is clamped to the image, and the shares of those to the right and below; ``last`` is the
    last column and row that may be the first. Of ``camera`` and positions see `_camera_of_row`.
    """

    def code(context: Any, builder: Any, signature: Any, values: list[Any]) -> Any:
        camera, x, y, start, last, *written, at = values
        kinds = signature.args
        camera = _data(context, builder, kinds[0], camera)
        x, y = (
            _load(builder, _address(builder, _data(context, builder, kind, array), start, _DOUBLES))
            for kind, array in zip(kinds[1:3], (x, y), strict=True)
        )
        outputs = [
            _data(context, builder, kind, array)
            for kind, array in zip(kinds[5:9], written, strict=True)
        ]

        def along(axis: int) -> Any:
            addresses = (builder.gep(camera, [_INDEX(3 * axis + i)]) for i in range(3))
            a, b, c = (_spread(builder, _DOUBLES, builder.load(number)) for number in addresses)
            return _times_plus(builder, a, x, _times_plus(builder, b, y, c))

        nearness = builder.fdiv(_all(_DOUBLES, 1.0), along(2))
        last = _spread(builder, _INTEGERS, last)
        end = builder.sitofp(builder.add(last, _all(_INTEGERS, 1)), _DOUBLES)
        middle = builder.fmul(end, _all(_DOUBLES, 0.5))
        for axis in range(2):
            position = _times_plus(builder, along(axis), nearness, middle)
            for sign, limit in ((">", _all(_DOUBLES, 0.0)), ("<", end)):
                inside = builder.fcmp_ordered(sign, position, limit)
                position = builder.select(inside, position, limit)
            pixel = builder.fptosi(position, _INTEGERS)
            pixel = builder.select(builder.icmp_signed("<", pixel, last), pixel, last)
            share = builder.fsub(position, builder.sitofp(pixel, _DOUBLES))
            _store(builder, pixel, _address(builder, outputs[axis], at, _INTEGERS))
            share = builder.fptrunc(share, _FLOATS)
            _store(builder, share, _address(builder, outputs[2 + axis], at))
        return context.get_dummy_value()

    index = types.uint64
    return types.void(camera, x, y, index, types.int32, column, row, right, below, index), code


@intrinsic  # type: ignore[untyped-decorator]
def _copy_transposed(
    typing: Any, scores: Any, start: Any, size: Any, count: Any, patch: Any, at: Any, width: Any
) -> Any:
    """Copy `LANES` pixels of `LANES` class planes so that the classes of a pixel lie together.

    ``patch[at + i * width + k] = scores[start + min(k, count - 1) * size + i]`` for i, k < LANES:
    where fewer classes are left the last is repeated, which wins no comparison it ties.
    """

    def code(context: Any, builder: Any, signature: Any, values: list[Any]) -> Any:
        scores, start, size, count, patch, at, width = values
        scores = _data(context, builder, signature.args[0], scores)
        patch = _data(context, builder, signature.args[4], patch)
        rows = []
        for k in range(LANES):
            rows.append(_load(builder, _address(builder, scores, start)))
            more = builder.icmp_unsigned("<", _INDEX(k + 1), count)
            start = builder.add(start, builder.select(more, size, _INDEX(0)))
        _transpose(builder, rows)
        for row in rows:
            _store(builder, row, _address(builder, patch, at))
            at = builder.add(at, width)
        return context.get_dummy_value()

    index = types.uint64
    return types.void(scores, index, index, index, patch, index, index), code


@intrinsic  # type: ignore[untyped-decorator]
def _interpolate(
    typing: Any,
    patch: Any,
    corner: Any,
    right: Any,
    below: Any,
    share: Any,
    share_below: Any,
    scores: Any,
    at: Any,
) -> Any:
    """Write `LANES` bilinear scores of a pixel, from ``at`` on.

    Interpolates between the vectors of ``patch`` at ``corner``, ``corner + right`` and the two
    that lie ``below`` floats further on.
    """

    def code(context: Any, builder: Any, signature: Any, values: list[Any]) -> Any:
        patch, corner, right, below, share, share_below, scores, at = values
        patch = _data(context, builder, signature.args[0], patch)
        scores = _data(context, builder, signature.args[6], scores)

        def between(first: Any, second: Any, share: Any) -> Any:
            step = builder.fsub(second, first, flags=_FUSED)
            return _times_plus(builder, _spread(builder, _FLOATS, share), step, first)

        def load(index: Any) -> Any:
            return _load(builder, _address(builder, patch, index))

        upper, lower = (
            between(load(left), load(builder.add(left, right)), share)
            for left in (corner, builder.add(corner, below))
        )
        _store(builder, between(upper, lower, share_below), _address(builder, scores, at))
        return context.get_dummy_value()

    index, real = types.uint64, types.float32
    return types.void(patch, index, index, index, real, real, scores, index), code


@intrinsic  # type: ignore[untyped-decorator]
def _compare(typing: Any, scores: Any, start: Any, best: Any, label: Any, at: Any) -> Any:
    """Compare `LANES` scores of each of `LANES` pixels with the best so far.

    Where one is larger it becomes ``best``, and its class ``label``, from ``at`` on; the first of
    equal ones. The classes are those from ``start`` on. NaN, as between two scores of −∞, is never
    larger.
    """

    def code(context: Any, builder: Any, signature: Any, values: list[Any]) -> Any:
        scores, start, best, label, at = values
        scores, best, label = (
            _data(context, builder, signature.args[i], array)
            for i, array in ((0, scores), (2, best), (3, label))
        )
        classes = [
            _load(builder, _address(builder, scores, _INDEX(i * LANES))) for i in range(LANES)
        ]
        _transpose(builder, classes)
        best, label = _address(builder, best, _INDEX(0)), _address(builder, label, at, _INTEGERS)
        most, found = _load(builder, best), _load(builder, label)
        first = _spread(builder, _INTEGERS, builder.trunc(start, _WORD))
        for k in range(LANES):
            larger = builder.fcmp_ordered(">", classes[k], most)
            most = builder.select(larger, classes[k], most)
            found = builder.select(larger, builder.add(first, _all(_INTEGERS, k)), found)
        _store(builder, most, best)
        _store(builder, found, label)
        return context.get_dummy_value()

    index = types.uint64
    return types.void(scores, index, best, label, index), code


@njit_fast
def _camera_of_row(
    axes: NDArray[np.float64],
    focal: float,
    cosine: float,
    sine: float,
    camera: NDArray[np.float64],
) -> None:
    """The camera of an image for ERP pixels of one row, of latitude ``cosine`` and ``sine``.

    ``camera`` becomes the 3 × 3 matrix that maps (cos λ, sin λ, 1), λ the longitude, to image
    coordinates, about the middle of the image.
    """
    for axis in range(3):
        scale = focal if axis < 2 else 1.0
        camera[3 * axis] = scale * cosine * axes[0, axis]
        camera[3 * axis + 1] = scale * cosine * axes[1, axis]
        camera[3 * axis + 2] = scale * sine * axes[2, axis]


@njit_fast
def _find_runs(
    owners: NDArray[np.integer],
    top: int,
    left: int,
    height: int,
    width: int,
    runs: NDArray[np.int32],
) -> int:
    """Pixels of a tile that lie side by side and have the same owner.

    Args:
        owners: ``(H, W)`` owners of the whole ERP.
        top: First row of the tile.
        left: First column of it.
        height: Rows of it.
        width: Columns of it.
        runs: Written: owner, row, first column and one past the last column of each.

    Returns:
        How many there are.
    """
    count = 0
    for i in range(top, top + height):
        first = left
        for j in range(left + 1, left + width + 1):
            if j == left + width or owners[i, j] != owners[i, first]:
                runs[count, 0] = owners[i, first]
                runs[count, 1], runs[count, 2], runs[count, 3] = i, first, j
                count += 1
                first = j
    return count


@njit_fast
def _range(values: NDArray[np.int32]) -> tuple[int, int]:
    """Smallest and largest."""
    low, high = values[0], values[0]
    for p in range(values.shape[0]):
        low, high = min(low, values[p]), max(high, values[p])
    return int(low), int(high)


@njit_fast
def _copy_patch(
    scores: NDArray[np.float32],
    start: int,
    num_classes: int,
    dim: int,
    height: int,
    width: int,
    patch: NDArray[np.float32],
) -> np.uint64:
    """Copy a part of an image to ``(height, width, vectors of LANES classes)``, flat.

    Args:
        scores: Flat ``(K, d, d)`` scores of all images.
        start: First element of the part.
        num_classes: K.
        dim: d.
        height: Rows of the part.
        width: Columns of the part, at least `LANES`.
        patch: Written.

    Returns:
        Floats per pixel of the patch.
    """
    size = np.uint64(dim * dim)
    pixel = np.uint64((num_classes + LANES - 1) // LANES * LANES)
    for y in range(height):
        for x in range(0, width, LANES):
            left = min(x, width - LANES)
            for k in range(0, num_classes, LANES):
                source = np.uint64(start + k * dim * dim + y * dim + left)
                at = np.uint64(y * width + left) * pixel + np.uint64(k)
                count = np.uint64(num_classes - k)
                _copy_transposed(scores, source, size, count, patch, at, pixel)
    return pixel


@njit_fast
def _project_owned(
    own: int,
    runs: NDArray[np.int32],
    axes: NDArray[np.float64],
    focal: float,
    dim: int,
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    rows: NDArray[np.float64],
    column: NDArray[np.int32],
    row: NDArray[np.int32],
    right: NDArray[np.float32],
    below: NDArray[np.float32],
) -> int:
    """`_project` the pixels of all runs of an image, run after run; how many they are."""
    camera = np.empty(9)
    n = 0
    for owner, i, first, end in runs:
        if owner != own:
            continue
        _camera_of_row(axes, focal, rows[i, 0], rows[i, 1], camera)
        for j in range(0, end - first, LANES):
            _project(
                camera, x, y, np.uint64(first + j), np.int32(dim - 2),
                column, row, right, below, np.uint64(n + j),
            )  # fmt: skip
        n += end - first
    return n


@njit_fast
def _find_corners(
    row: NDArray[np.int32],
    first_row: int,
    column: NDArray[np.int32],
    first_column: int,
    patch_width: int,
    pixel: np.uint64,
    corner: NDArray[np.uint64],
) -> None:
    """Where in the patch the first of the four pixels around each position lies."""
    for q in range(row.shape[0]):
        at = (row[q] - first_row) * patch_width + column[q] - first_column
        corner[q] = np.uint64(at) * pixel


@njit_fast
def _best_classes(
    num_classes: int,
    patch: NDArray[np.float32],
    pixel: np.uint64,
    line: np.uint64,
    corner: NDArray[np.uint64],
    right: NDArray[np.float32],
    below: NDArray[np.float32],
    label: NDArray[np.int32],
) -> None:
    """First class of the largest score of each pixel."""
    values, best = np.empty(LANES**2, np.float32), np.empty(LANES, np.float32)
    n = np.uint64(corner.shape[0])
    lanes = np.uint64(LANES)
    for p in range(np.uint64(0), n, lanes):
        best[:] = -np.inf
        label[p : p + lanes] = 0
        for k in range(np.uint64(0), np.uint64(num_classes), lanes):
            for q in range(p, min(p + lanes, n)):
                _interpolate(
                    patch, corner[q] + k, pixel, line, right[q], below[q], values, (q - p) * lanes
                )
            _compare(values, k, best, label, p)


@njit_fast
def _write_owned(
    own: int, runs: NDArray[np.int32], label: NDArray[np.int32], labels: NDArray[np.integer]
) -> None:
    """Write the labels of the pixels of all runs of an image, run after run."""
    n = 0
    for owner, i, first, end in runs:
        if owner == own:
            for j in range(first, end):
                labels[i, j] = label[n + j - first]
            n += end - first


@njit_fast
def owner_labels(
    start: int,
    stop: int,
    scores: NDArray[np.float32],
    owners: NDArray[np.integer],
    axes: NDArray[np.float64],
    focal: float,
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    labels: NDArray[np.integer],
) -> None:
    """Class of the largest bilinear score in the owner's image, rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        scores: ``(N, K, d, d)`` float32, d at least `LANES`.
        owners: ``(H, W)`` owners.
        axes: ``(N, 3, 3)`` camera axes of the images, as columns.
        focal: Focal length of the images in pixels.
        columns: From `directions_of_rows`.
        rows: From `directions_of_rows`.
        labels: ``(H, W)`` class indices, written.
    """
    num_images, num_classes, dim = scores.shape[:3]
    flat = scores.reshape(-1)
    pixels = _TILE[0] * _TILE[1]
    runs = np.empty((pixels, 4), np.int32)
    # A vector may reach past the last pixel.
    column, row, label = np.empty((3, pixels + LANES), np.int32)
    right, below = np.empty((2, pixels + LANES), np.float32)
    x, y = np.zeros((2, len(columns) + LANES))
    x[: len(columns)], y[: len(columns)] = columns[:, 0], columns[:, 1]
    corner = np.empty(pixels, np.uint64)
    patch = np.empty(0, np.float32)
    done = np.empty(num_images, np.bool_)
    for top in range(start, stop, _TILE[0]):
        height = min(stop - top, _TILE[0])
        for left in range(0, owners.shape[1], _TILE[1]):
            width = min(owners.shape[1] - left, _TILE[1])
            count = _find_runs(owners, top, left, height, width, runs)
            done[:] = False
            for first_run in range(count):
                own = runs[first_run, 0]
                if done[own]:
                    continue
                done[own] = True
                n = _project_owned(
                    own, runs[first_run:count], axes[own], focal, dim, x, y, rows,
                    column, row, right, below,
                )  # fmt: skip
                first_row, last_row = _range(row[:n])
                first_column, last_column = _range(column[:n])
                patch_height = last_row - first_row + 2
                patch_width = max(last_column - first_column + 2, LANES)
                first_column = min(first_column, dim - patch_width)
                needed = patch_height * patch_width * (num_classes + LANES)
                if len(patch) < needed:
                    patch = np.empty(needed, np.float32)
                source = (own * num_classes * dim + first_row) * dim + first_column
                pixel = _copy_patch(
                    flat, source, num_classes, dim, patch_height, patch_width, patch
                )
                _find_corners(
                    row[:n], first_row, column[:n], first_column, patch_width, pixel, corner[:n]
                )
                _best_classes(
                    num_classes, patch, pixel, np.uint64(patch_width) * pixel, corner[:n],
                    right, below, label,
                )  # fmt: skip
                _write_owned(own, runs[first_run:count], label, labels)
