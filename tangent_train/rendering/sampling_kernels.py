"""Compiled sampling of panoramas: colours between pixels, and the nearest pixel of anything.

What is wanted of a row of positions is found for all of them first, which numba turns into vector
code. To mix four pixels of three values it does not: that is written in LLVM's vector types, which
any processor runs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.extending import intrinsic
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_exact

__all__ = ["sample_colors", "sample_nearest"]

_BYTE, _WORD, _FLOAT = ir.IntType(8), ir.IntType(32), ir.FloatType()
_LOADED = 8
"""Values read at once: two pixels, and two values that are not used."""
_AHEAD, _EVERY = np.uint64(8), np.uint64(8)
"""So many rows before they are needed, every so many positions, memory is asked for a pixel.

The rows of a panorama lie too far apart for a processor to guess what comes next.
"""


def _lanes(values: list[int]) -> ir.Constant:
    return ir.Constant(ir.VectorType(_WORD, len(values)), values)


@intrinsic  # type: ignore[untyped-decorator]
def _mix(
    typing: Any, image: Any, upper: Any, lower: Any, right: Any, below: Any, out: Any, at: Any
) -> Any:
    """Write three values between two neighbours at `upper` and the two at `lower`, and a fourth.

    Reads `_LOADED` values of the flat ``image`` at both offsets. Integers are rounded.
    """

    def code(context: Any, builder: Any, signature: Any, values: list[Any]) -> Any:
        image, upper, lower, right, below, out, at = values
        kinds = signature.args
        value_kind = context.get_data_type(kinds[0].dtype)
        integer = isinstance(value_kind, ir.IntType)

        def address(kind: Any, array: Any, offset: Any, count: int) -> Any:
            data = context.make_array(kind)(context, builder, array).data
            vector = ir.VectorType(value_kind, count).as_pointer()
            return builder.bitcast(builder.gep(data, [offset]), vector)

        def load(offset: Any) -> Any:
            value = builder.load(address(kinds[0], image, offset, _LOADED))
            value.align = value_kind.width // 8 if integer else 4
            return builder.uitofp(value, ir.VectorType(_FLOAT, _LOADED)) if integer else value

        def between(first: Any, second: Any, share: Any) -> Any:
            undefined = ir.Constant(first.type, ir.Undefined)

            def times(vector: Any, factor: Any) -> Any:
                spread = builder.insert_element(undefined, factor, _WORD(0))
                spread = builder.shuffle_vector(spread, undefined, _lanes([0] * first.type.count))
                return builder.fmul(vector, spread)

            return builder.fadd(times(first, builder.fsub(_FLOAT(1), share)), times(second, share))

        column = between(load(upper), load(lower), below)
        left, other = (
            builder.shuffle_vector(column, column, _lanes(lanes))
            for lanes in ([0, 1, 2, 2], [3, 4, 5, 5])
        )
        mixed = between(left, other, right)
        if integer:
            kind = ir.FunctionType(mixed.type, [mixed.type])
            rounded = get_or_insert_function(builder.module, kind, "llvm.rint.v4f32")
            mixed = builder.fptosi(builder.call(rounded, [mixed]), ir.VectorType(_WORD, 4))
            mixed = builder.trunc(mixed, ir.VectorType(value_kind, 4))
        builder.store(mixed, address(kinds[5], out, at, 4)).align = 1
        return context.get_dummy_value()

    offset, share = types.int64, types.float32
    return types.void(image, offset, offset, share, share, out, offset), code


@intrinsic  # type: ignore[untyped-decorator]
def _prefetch(typing: Any, image: Any, offset: Any) -> Any:
    """Ask for a value that will be read soon."""

    def code(context: Any, builder: Any, signature: Any, values: list[Any]) -> Any:
        image, offset = values
        data = context.make_array(signature.args[0])(context, builder, image).data
        address = builder.bitcast(builder.gep(data, [offset]), _BYTE.as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [address.type, _WORD, _WORD, _WORD])
        function = get_or_insert_function(builder.module, kind, "llvm.prefetch.p0i8")
        builder.call(function, [address, _WORD(0), _WORD(3), _WORD(1)])
        return context.get_dummy_value()

    return types.void(image, types.int64), code


@njit_exact
def sample_colors(
    start: int,
    stop: int,
    height: int,
    width: int,
    image: NDArray[np.uint8] | NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    out: NDArray[np.uint8] | NDArray[np.float32],
) -> None:
    """Bilinear colours of an ERP at the positions of the rows ``start:stop``; longitude wraps.

    8-bit colours are rounded once. Beyond the first and last rows lie the same rows again.

    Args:
        start: First row.
        stop: One past the last row.
        height: Rows H of the ERP.
        width: Columns W of the ERP.
        image: ``(3 H W,)`` the ERP, uint8 or float32, less than 2³¹ values.
        u: ``(h, w)`` columns in [−½, W − ½].
        v: ``(h, w)`` rows in [−½, H − ½].
        out: ``(3 h w,)`` of the same dtype, written.
    """
    length = u.shape[1]
    column, upper, lower = np.empty((3, length), np.int32)
    right, below = np.empty((2, length), np.float32)
    last_column, last_row = np.int32(width - 1), np.int32(height - 1)
    last_load = np.int32(len(image) - _LOADED)
    one, whole = np.int32(1), np.float32(1)
    last = np.uint64(length - 1)
    for i in range(np.uint64(start), np.uint64(stop)):
        row_u, row_v = u[i], v[i]
        if i + _AHEAD < np.uint64(stop):
            soon_u, soon_v = u[i + _AHEAD], v[i + _AHEAD]
            for j in range(np.uint64(0), np.uint64(length), _EVERY):
                _prefetch(image, (np.int64(soon_v[j]) * width + np.int64(soon_u[j])) * 3)
        for j in range(np.uint64(length)):
            c = np.int32(row_u[j] + whole) - one
            r = np.int32(row_v[j] + whole) - one
            column[j] = c
            upper[j] = np.int32((max(r, np.int32(0)) * np.int32(width) + c) * np.int32(3))
            lower[j] = np.int32((min(r + one, last_row) * np.int32(width) + c) * np.int32(3))
            right[j] = row_u[j] - np.float32(c)
            below[j] = row_v[j] - np.float32(r)
        at = np.int64(i) * 3 * length
        for j in range(np.uint64(length)):
            if 0 <= column[j] < last_column and lower[j] <= last_load and j < last:
                # It writes a value of the next pixel too, which comes next.
                _mix(image, upper[j], lower[j], right[j], below[j], out, at)
            else:
                west = 3 * width if column[j] < 0 else 0
                east = 3 - 3 * width if column[j] >= last_column else 3
                x, y = right[j], below[j]
                for k in range(3):
                    a, b = image[upper[j] + west + k], image[upper[j] + east + k]
                    c, d = image[lower[j] + west + k], image[lower[j] + east + k]
                    left = np.float32(a) * (whole - y) + np.float32(c) * y
                    other = np.float32(b) * (whole - y) + np.float32(d) * y
                    mixed = left * (whole - x) + other * x
                    out[at + k] = np.rint(mixed) if image.itemsize == 1 else mixed
            at += 3


@njit_exact
def sample_nearest(
    start: int,
    stop: int,
    height: int,
    width: int,
    image: NDArray[np.generic],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    out: NDArray[np.generic],
) -> None:
    """The nearest pixels of an ERP, of two the even one, at the positions of rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        height: Rows H of the ERP.
        width: Columns W of the ERP.
        image: ``(H W,)`` the ERP, less than 2³¹ pixels.
        u: ``(h, w)`` columns in [−½, W − ½].
        v: ``(h, w)`` rows in [−½, H − ½].
        out: ``(h w,)`` written.
    """
    index = np.empty(u.shape[1], np.int32)
    last_row = np.int32(height - 1)
    for i in range(np.uint64(start), np.uint64(stop)):
        row_u, row_v = u[i], v[i]
        row = out[i * np.uint64(len(index)) : (i + np.uint64(1)) * np.uint64(len(index))]
        if i + _AHEAD < np.uint64(stop):
            soon_u, soon_v = u[i + _AHEAD], v[i + _AHEAD]
            for j in range(np.uint64(0), np.uint64(len(index)), _EVERY):
                _prefetch(image, np.int64(soon_v[j]) * width + np.int64(soon_u[j]))
        for j in range(np.uint64(len(index))):
            c = np.int32(np.rint(row_u[j]))
            r = min(np.int32(np.rint(row_v[j])), last_row)
            c = c + np.int32(width) if c < 0 else c
            c = c - np.int32(width) if c >= np.int32(width) else c
            index[j] = np.int32(r * np.int32(width) + c)
        for j in range(np.uint64(len(index))):
            row[j] = image[np.uint64(index[j])]
