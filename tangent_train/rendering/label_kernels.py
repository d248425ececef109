"""Compiled label rendering: the class of the largest score in the owner's image.

All classes of a pixel are interpolated and compared at once, in vector registers. Numba turns
loops over neighbouring pixels into vector code, not these; so the two steps that need it are
written in LLVM's vector types, which any processor runs: with AVX-512 a vector is one register,
elsewhere two or four.
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
"""Classes compared at once, and the smallest side of an image."""

_TILE = (64, 64)
"""Rows and columns rendered at once, so that their scores stay in the cache."""

_INDEX = ir.IntType(64)
_VECTOR = ir.VectorType(ir.FloatType(), LANES)


def _order(lanes: list[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes)


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Address of the `LANES` floats of a flat array that start at an index."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())


def _load(builder: Any, address: Any) -> Any:
    value = builder.load(address)
    value.align = 4
    return value


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
        kinds = signature.args
        rows = []
        for k in range(LANES):
            address = _address(context, builder, kinds[0], scores, start)
            rows.append(_load(builder, address))
            more = builder.icmp_unsigned("<", _INDEX(k + 1), count)
            start = builder.add(start, builder.select(more, size, _INDEX(0)))
        # Transposed by exchanging, bit by bit, that bit of the row and of the lane.
        for bit in (1 << b for b in range(LANES.bit_length() - 1)):
            even = _order([LANES + (i ^ bit) if i & bit else i for i in range(LANES)])
            odd = _order([LANES + i if i & bit else i | bit for i in range(LANES)])
            for i in range(LANES):
                if not i & bit:
                    pair = rows[i], rows[i | bit]
                    rows[i] = builder.shuffle_vector(*pair, even)
                    rows[i | bit] = builder.shuffle_vector(*pair, odd)
        for row in rows:
            address = _address(context, builder, kinds[4], patch, at)
            builder.store(row, address).align = 4
            at = builder.add(at, width)
        return context.get_dummy_value()

    index = types.uint64
    return types.void(scores, index, index, index, patch, index, index), code


@intrinsic  # type: ignore[untyped-decorator]
def _best_class(
    typing: Any, patch: Any, corner: Any, right: Any, below: Any, share: Any, share_below: Any
) -> Any:
    """First class of the largest of `LANES` bilinear scores, and that score.

    Interpolates between the vectors of ``patch`` at ``corner``, ``corner + right`` and the two
    that lie ``below`` floats further on.
    """

    def code(context: Any, builder: Any, signature: Any, values: list[Any]) -> Any:
        patch, corner, right, below, share, share_below = values
        undefined = ir.Constant(_VECTOR, ir.Undefined)

        def spread(value: Any) -> Any:
            first = builder.insert_element(undefined, value, ir.IntType(32)(0))
            return builder.shuffle_vector(first, undefined, _order([0] * LANES))

        def load(index: Any) -> Any:
            return _load(builder, _address(context, builder, signature.args[0], patch, index))

        def between(first: Any, second: Any, share: Any) -> Any:
            flags = ("contract",)
            step = builder.fsub(second, first, flags=flags)
            return builder.fadd(first, builder.fmul(share, step, flags=flags), flags=flags)

        upper, lower = (
            between(load(left), load(builder.add(left, right)), spread(share))
            for left in (corner, builder.add(corner, below))
        )
        scores = between(upper, lower, spread(share_below))
        # Between two scores of −∞ lies NaN: never the largest.
        lowest = ir.Constant(_VECTOR, [float("-inf")] * LANES)
        scores = builder.select(builder.fcmp_ordered("ord", scores, scores), scores, lowest)
        best = scores
        for step in (LANES >> b for b in range(1, LANES.bit_length())):
            turned = _order([(i + step) % LANES for i in range(LANES)])
            other = builder.shuffle_vector(best, undefined, turned)
            best = builder.select(builder.fcmp_ordered(">", best, other), best, other)
        reached = builder.bitcast(builder.fcmp_ordered("==", scores, best), ir.IntType(LANES))
        first = builder.zext(builder.cttz(reached, ir.IntType(1)(1)), _INDEX)
        value = builder.extract_element(best, ir.IntType(32)(0))
        return context.make_tuple(builder, signature.return_type, [first, value])

    index, real = types.uint64, types.float32
    result = types.Tuple((index, real))
    return result(patch, index, index, index, real, real), code


@njit_fast
def _project(
    axes: NDArray[np.float64],
    focal: float,
    middle: float,
    columns: NDArray[np.float64],
    cosine: float,
    sine: float,
    u: NDArray[np.float64],
    v: NDArray[np.float64],
) -> None:
    """Positions in an image of ERP pixels of one row, of latitude ``cosine`` and ``sine``.

    Unbounded where the image does not see them. Only sums, in a loop of its own: vector code.
    """
    scale = focal * cosine
    ux, uy, uz = scale * axes[0, 0], scale * axes[1, 0], focal * sine * axes[2, 0]
    vx, vy, vz = scale * axes[0, 1], scale * axes[1, 1], focal * sine * axes[2, 1]
    zx, zy, zz = cosine * axes[0, 2], cosine * axes[1, 2], sine * axes[2, 2]
    for j in range(u.shape[0]):
        x, y = columns[j, 0], columns[j, 1]
        nearness = 1 / (zx * x + zy * y + zz)
        u[j] = (ux * x + uy * y + uz) * nearness + middle
        v[j] = (vx * x + vy * y + vz) * nearness + middle


@njit_fast
def _split(
    position: NDArray[np.float64],
    dim: int,
    first: NDArray[np.int32],
    share: NDArray[np.float32],
) -> None:
    """First of the two pixels around a position, clamped to the image, and the second's share."""
    end = np.int32(dim - 2)
    for p in range(position.shape[0]):
        x = min(max(position[p], 0.0), dim - 1.0)
        pixel = min(np.int32(x), end)
        first[p] = pixel
        share[p] = x - pixel


@njit_fast
def _range(
    values: NDArray[np.int32],
    owners: NDArray[np.int32],
    owner: int,
) -> tuple[int, int]:
    """Smallest and largest value where an image is the owner."""
    most = np.int32(2**31 - 1)
    low, high = most, np.int32(-1)
    for p in range(values.shape[0]):
        own = owners[p] == owner
        low = min(low, values[p] if own else most)
        high = max(high, values[p] if own else np.int32(-1))
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
def _class_at(
    patch: NDArray[np.float32],
    corner: np.uint64,
    right: np.uint64,
    below: np.uint64,
    share: np.float32,
    share_below: np.float32,
    num_classes: int,
) -> np.uint64:
    """`_best_class` of any number of classes."""
    found, best = _best_class(patch, corner, right, below, share, share_below)
    for k in range(LANES, num_classes, LANES):
        start = np.uint64(k)
        other, score = _best_class(patch, corner + start, right, below, share, share_below)
        if score > best:
            found, best = start + other, score
    return found


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
    u, v = np.empty(_TILE[0] * _TILE[1]), np.empty(_TILE[0] * _TILE[1])
    column, row = np.empty(len(u), np.int32), np.empty(len(u), np.int32)
    right, below = np.empty(len(u), np.float32), np.empty(len(u), np.float32)
    owner, label = np.empty(len(u), np.int32), np.empty(len(u), np.int32)
    patch = np.empty(0, np.float32)
    done = np.empty(num_images, np.bool_)
    for top in range(start, stop, _TILE[0]):
        height = min(stop - top, _TILE[0])
        for left in range(0, owners.shape[1], _TILE[1]):
            width = min(owners.shape[1] - left, _TILE[1])
            n = height * width
            for i in range(height):
                owner[i * width : (i + 1) * width] = owners[top + i, left : left + width]
            done[:] = False
            previous = -1
            for p in range(n):
                own = owner[p]
                if own == previous or done[own]:
                    continue
                previous = own
                done[own] = True
                for i in range(height):
                    line = slice(i * width, (i + 1) * width)
                    _project(
                        axes[own], focal, (dim - 1) / 2, columns[left : left + width],
                        rows[top + i, 0], rows[top + i, 1], u[line], v[line],
                    )  # fmt: skip
                _split(u[:n], dim, column, right)
                _split(v[:n], dim, row, below)
                first_row, last_row = _range(row[:n], owner, own)
                first_column, last_column = _range(column[:n], owner, own)
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
                for q in range(p, n):
                    if owner[q] != own:
                        continue
                    at = (row[q] - first_row) * patch_width + column[q] - first_column
                    corner, line_step = np.uint64(at) * pixel, np.uint64(patch_width) * pixel
                    label[q] = _class_at(
                        patch, corner, pixel, line_step, right[q], below[q], num_classes
                    )
            labels[top : top + height, left : left + width] = label[:n].reshape(height, width)
