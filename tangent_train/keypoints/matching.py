"""Putative matches: nearest neighbours among descriptors, exactly."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, get_args

import numpy as np

from tangent_train.errors import SettingError
from tangent_train.keypoints.detectors import Norm
from tangent_train.rendering.compiled import njit_exact

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["match"]

_ROWS, _COLUMNS = 512, 4096
"""Sides of the block of distances that is held: 8 MiB in float32."""


def match(
    left_descriptors: NDArray[np.generic],
    right_descriptors: NDArray[np.generic],
    norm: Norm = "l2",
    ratio: float = 0.8,
    *,
    mutual: bool = True,
) -> NDArray[np.int64]:
    """For every left descriptor its nearest right one, where that is clear.

    All distances are computed, as matrix products in blocks: time grows with n_l · n_r, memory
    with n_l + n_r. They are exact for whole numbers up to 255, as SIFT's, and for bits; others are
    compared in float64. Of right descriptors at the same distance the first is the nearest.

    Args:
        left_descriptors: ``(n_l, D)`` numbers, or bytes of bits for ``hamming``.
        right_descriptors: ``(n_r, D)``.
        norm: ``l2``, the Euclidean distance, or ``hamming``, the number of different bits.
        ratio: Keep a match whose distance is less than this share of the distance to the second
            nearest (Lowe 2004; the paper's matches have 0.8). Where two right descriptors are at
            the same distance there is none, and where there is only one right descriptor nothing
            contradicts it. 1 or more: keep all.
        mutual: Keep a match only if the left one is also the nearest to the right one. Without it
            several left keypoints may share a right one.

    Returns:
        ``(m, 2)`` indices of left and right descriptors, by the left ones.

    Raises:
        SettingError: The norm is unknown, the ratio not positive, or the descriptors do not fit
            each other or the norm.
    """
    if norm not in get_args(Norm):
        raise SettingError("norm", found=norm, expected=" or ".join(get_args(Norm)))
    if not ratio > 0:
        raise SettingError("ratio", found=ratio, expected="above 0, 0.8 by default")
    left, right = _numbers(left_descriptors, right_descriptors, norm)
    if not (len(left) and len(right)):
        return np.empty((0, 2), np.int64)
    nearest, first, second = _neighbours(left, right)
    # Squared Euclidean distances of bits are their Hamming distances.
    share = ratio if norm == "hamming" else ratio * ratio
    clear = first < share * second if ratio < 1 else np.full(len(left), True)
    chosen = np.flatnonzero(clear)
    if mutual and len(chosen):
        wanted, place = np.unique(nearest[chosen], return_inverse=True)
        chosen = chosen[_neighbours(right[wanted], left).nearest[place] == chosen]
    return np.stack([chosen, nearest[chosen]], axis=1)


class _Neighbours(NamedTuple):
    """The nearest right descriptor of every left one, and two squared distances.

    Attributes:
        nearest: ``(n,)`` indices, the first of several.
        first: ``(n,)`` float64 squared distance of the nearest.
        second: ``(n,)`` that of the second nearest, infinite where there is none.
    """

    nearest: NDArray[np.int64]
    first: NDArray[np.float64]
    second: NDArray[np.float64]


def _neighbours(left: NDArray[np.floating], right: NDArray[np.floating]) -> _Neighbours:
    nearest = np.zeros(len(left), np.int64)
    first, second = np.full((2, len(left)), np.inf, left.dtype)
    squares = np.einsum("nd,nd->n", right, right)
    products = np.empty(_ROWS * min(_COLUMNS, len(right)), left.dtype)
    for top in range(0, len(left), _ROWS):
        rows = slice(top, top + _ROWS)
        part = left[rows]
        for start in range(0, len(right), _COLUMNS):
            across = right[start : start + _COLUMNS]
            block = products[: len(part) * len(across)].reshape(len(part), len(across))
            np.matmul(part, across.T, out=block)
            lengths = squares[start : start + _COLUMNS]
            _update(block, lengths, start, nearest[rows], first[rows], second[rows])
    own = np.einsum("nd,nd->n", left, left).astype(np.float64)
    return _Neighbours(nearest, *(np.maximum(own + value, 0) for value in (first, second)))


@njit_exact
def _update(
    products: NDArray[np.floating],
    squares: NDArray[np.floating],
    start: int,
    nearest: NDArray[np.int64],
    first: NDArray[np.floating],
    second: NDArray[np.floating],
) -> None:
    """Take a block of scalar products into the two smallest distances of every row.

    Args:
        products: ``(r, c)`` scalar products of left and right descriptors.
        squares: ``(c,)`` squared lengths of the right ones.
        start: Index of the first right one.
        nearest: ``(r,)`` so far, written.
        first: ``(r,)`` squared distance less the squared length of the left one, written.
        second: ``(r,)`` the same of the second nearest, written.
    """
    for i in range(products.shape[0]):
        best, next_best, index = first[i], second[i], nearest[i]
        for j in range(products.shape[1]):
            # x + x is exact in every precision, and stays in it.
            product = products[i, j]
            value = squares[j] - (product + product)
            if value < next_best:
                if value < best:
                    next_best = best
                    best = value
                    index = start + j
                else:
                    next_best = value
        first[i], second[i], nearest[i] = best, next_best, index


def _numbers(
    left: NDArray[np.generic], right: NDArray[np.generic], norm: Norm
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Both as numbers of one type whose products are exact or nearly so."""
    shapes = [array.shape for array in (left, right)]
    if [len(shape) for shape in shapes] != [2, 2] or shapes[0][1] != shapes[1][1]:
        raise SettingError(
            "descriptors", found=f"arrays {shapes[0]} and {shapes[1]}", expected="(n, D) and (m, D)"
        )
    if norm == "hamming":
        for array in (left, right):
            if array.dtype != np.uint8:
                raise SettingError(
                    "norm=hamming", found=f"{array.dtype} descriptors", expected="bytes of bits"
                )
        bits = (np.unpackbits(array.view(np.uint8), axis=1) for array in (left, right))
        first, second = (array.astype(np.float32) for array in bits)
        return first, second
    exact = _whole_bytes(left) and _whole_bytes(right)
    dtype = np.float32 if exact and shapes[0][1] <= _EXACT_LENGTH else np.float64
    return left.astype(dtype, copy=False), right.astype(dtype, copy=False)


_EXACT_LENGTH = 2**24 // 255**2
"""Numbers up to 255 whose squares float32 adds up exactly."""


def _whole_bytes(array: NDArray[np.generic]) -> bool:
    """Whether all are whole numbers from 0 to 255.

    Raises:
        SettingError: Some are no numbers.
    """
    if array.dtype == np.uint8:
        return True
    if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise SettingError("descriptors", found="some that are no numbers", expected="finite ones")
    numbers = array.astype(np.float64, copy=False)
    return bool(((numbers >= 0) & (numbers <= 255) & (numbers == np.rint(numbers))).all())
