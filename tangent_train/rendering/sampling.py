"""Positions in panoramas and images, and the pixels around them.

The ray of pixel (i, j) of a panorama or image is
``(rows[i, 0] columns[0, j], rows[i, 0] columns[1, j], rows[i, 1])``, with the factors of
`sphere_rays` or `plane_rays`.

Tensors are sampled as sparse sums, differentiably: every output value is a weighted sum of a few
*taps*, flat indices into the source, one weight each. Both directions of rendering differ only in
how the taps are found. Arrays are sampled by `sample_map`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.geometry import equirect_latitudes, equirect_longitudes
from tangent_train.rendering.compiled import njit_exact, over_rows

Array = NDArray[Any]
Rays = tuple[Array, Array]
"""``(2, W)`` factors of the columns and ``(H, 2)`` factors of the rows, float64."""

_REMAP_LIMIT = 32767
"""cv2.remap requires sides below SHRT_MAX."""
_REMAP_BILINEAR = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
_SAME_SIZE = {1: np.uint8, 2: np.uint16, 4: np.float32, 8: np.float64}
"""Nearest sampling copies bytes: a dtype of the same size stands for every other."""
_BLOCK = 2**18
"""Number of positions sampled at once where cv2 cannot be used."""
_COPIED = 36
"""Largest part of a panorama that is copied, in bytes per position: copying more takes longer."""


def sphere_rays(shape: tuple[int, int]) -> Rays:
    """Return the rays of a panorama, unit directions: cos λ, sin λ and cos φ, sin φ."""
    lat, lon = equirect_latitudes(shape[0]), equirect_longitudes(shape[1])
    return np.stack([np.cos(lon), np.sin(lon)]), np.stack([np.cos(lat), np.sin(lat)], -1)


def plane_rays(shape: tuple[int, int]) -> Rays:
    """Return the rays ``(j, 1, i)`` of an image: homogeneous pixels in another order."""
    height, width = shape
    columns = np.stack([np.arange(width, dtype=np.float64), np.ones(width)])
    return columns, np.stack([np.ones(height), np.arange(height, dtype=np.float64)], -1)


def map_dtype(exact: bool, interpolation: str) -> np.dtype[np.floating]:
    """Return the dtype of positions: float64 if `exact` and bilinear, else float32.

    Nearest sampling uses the same positions for all dtypes.
    """
    return np.dtype(np.float64 if exact and interpolation == "bilinear" else np.float32)


class EquirectMap(NamedTuple):
    """Positions in an ERP, relative to the part of it that contains them.

    Attributes:
        u: ``(h, w)`` columns in the part, float32 or float64.
        v: ``(h, w)`` rows in the part, same dtype.
        polar: Flat indices of positions between a pole and the row next to it.
        part: First row, row after the last, first column and column after the last, int64. Columns
            W and higher are beyond the seam.
    """

    u: NDArray[np.floating]
    v: NDArray[np.floating]
    polar: NDArray[np.intp]
    part: NDArray[np.int64]

    @classmethod
    def of(
        cls, u: NDArray[np.floating], v: NDArray[np.floating], shape: tuple[int, int]
    ) -> EquirectMap:
        """Find the part that contains some positions.

        Args:
            u: ``(h, w)`` columns in [−½, W − ½], float32 or float64.
            v: ``(h, w)`` rows in [−½, H − ½], same dtype.
            shape: ``(H, W)`` of the ERP.
        """
        height, width = shape
        polar = np.flatnonzero((v < 0) | (v > height - 1))
        # Columns of the left half are rounded as if beyond the seam, so that all parts agree.
        beyond, left_half = u + u.dtype.type(width), u < width / 2
        u = np.where(left_half, beyond - u.dtype.type(width), u)
        # An even offset keeps the choice between two equally near pixels, which is the even one.
        top, left = (int(line.min()) // 2 * 2 for line in (v, u))
        bottom, right = min(height, int(v.max()) + 2), int(u.max()) + 2
        if u.min() < 0 or right - left > width / 2:
            joined = np.where(left_half, beyond, u)
            left, right = int(joined.min()) // 2 * 2, int(joined.max()) + 2
            if right - left > width / 2:
                left, right = 0, width
            else:
                u = joined
        part = np.array((top, bottom, left, right))
        return cls(u - u.dtype.type(left), v - u.dtype.type(top), polar, part)

    def in_panorama(
        self, chosen: NDArray[np.intp] | slice = slice(None)
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return columns, some beyond the seam, and rows ``(P,)`` in the ERP of some positions."""
        top, _, left, _ = self.part.astype(self.u.dtype)
        return self.u.reshape(-1)[chosen] + left, self.v.reshape(-1)[chosen] + top


def equirect_map(
    matrices: NDArray[np.float64],
    rays: Rays,
    shape: tuple[int, int],
    dtype: np.dtype[np.floating],
) -> EquirectMap:
    """Return the positions in an ERP of the rays of n canvases, stacked vertically.

    Args:
        matrices: ``(n, 3, 3)`` from the rays of each canvas to directions of any length.
        rays: Rays of a canvas of ``(h, w)`` pixels.
        shape: ``(H, W)`` of the ERP.
        dtype: float32 or float64; the computation is float64 in both cases.

    Returns:
        Positions ``(n h, w)``.
    """
    columns, rows = rays
    u, v = np.empty((2, len(matrices) * len(rows), columns.shape[1]), dtype)
    over_rows(equirect_positions, *u.shape, np.ascontiguousarray(matrices), *rays, *shape, u, v)
    return EquirectMap.of(u, v, shape)


@njit_exact
def equirect_positions(
    start: int, stop: int, matrices: Array, columns: Array, rows: Array,
    height: int, width: int, u: Array, v: Array,
) -> None:  # fmt: skip
    """Write ERP positions of the rays of stacked canvases, rows ``start:stop``.

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


def sample_map(
    table: EquirectMap,
    image: NDArray[np.generic],
    interpolation: str,
    out: NDArray[np.generic],
) -> None:
    """Sample a panorama; longitude wraps, and rows reflect at the poles.

    `cv2.remap` samples uint8, uint16 and float32 bilinearly, and the nearest pixel of all dtypes.
    OpenCV 4 may round positions to 1/32 pixel, which is invisible in 8-bit images; OpenCV 5 does
    not. Other dtypes are sampled without rounding.

    Args:
        table: Positions ``(h, w)``.
        image: ``(H, W[, C])``, contiguous.
        interpolation: ``bilinear`` or ``nearest``.
        out: ``(h, w[, C])`` contiguous, same dtype, written.
    """
    nearest = interpolation == "nearest"
    if nearest:
        plain = _SAME_SIZE[image.dtype.itemsize]
        image, out = image.view(plain), out.view(plain)
    small = max(*image.shape[:2], *table.u.shape) < _REMAP_LIMIT
    if not small or not (nearest or image.dtype in _REMAP_BILINEAR):
        _gather(table, image, nearest, out, np.arange(table.u.size))
        return
    _remap(table, image, nearest, out)
    if not nearest and len(table.polar):  # cv2 would continue at the other pole
        _gather(table, image, nearest, out, table.polar)


def _remap(
    table: EquirectMap, image: NDArray[np.generic], nearest: bool, out: NDArray[np.generic]
) -> None:
    top, bottom, left, right = table.part.tolist()
    part = image[top:bottom, left:right]
    if right > image.shape[1]:
        part = np.concatenate([part, image[top:bottom, : right - image.shape[1]]], axis=1)
    # Copying the part row by row takes less time than waiting for memory at every position.
    copied = image.dtype.itemsize < 4 and part.nbytes <= _COPIED * table.u.size
    u, v = (line.astype(np.float32, copy=False) for line in table[:2])
    if nearest and len(table.polar):
        v = v.clip(0, len(part) - 1)
    flag = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    channels = 1 if image.ndim == 2 else image.shape[2]
    padded = copied and channels % 3 == 0 and not nearest
    if image.ndim == 2 or (channels in (3, 4) and not padded):
        part = np.ascontiguousarray(part) if copied else part
        cv2.remap(part, u, v, flag, dst=out, borderMode=cv2.BORDER_WRAP)
        return
    # cv2 is fastest with 4 channels. It refuses more than 4, or rounds their positions.
    several = 3 if channels % 3 == 0 else 1
    for first in range(0, channels, several):
        group = part[..., first : first + several]
        if padded:
            group = cv2.cvtColor(group, cv2.COLOR_RGB2RGBA)
        sampled = cv2.remap(group, u, v, flag, borderMode=cv2.BORDER_WRAP)
        if padded:
            sampled = cv2.cvtColor(sampled, cv2.COLOR_RGBA2RGB)
        out[..., first : first + several] = sampled.reshape(*out.shape[:2], several)


def _gather(
    table: EquirectMap,
    image: NDArray[np.generic],
    nearest: bool,
    out: NDArray[np.generic],
    chosen: NDArray[np.intp],
) -> None:
    """Sample chosen positions with torch, for dtypes and sizes that cv2 does not support."""
    shape = image.shape[0], image.shape[1]
    source = image.reshape(shape[0] * shape[1], -1)
    target = out.reshape(table.u.size, -1)
    for start in range(0, len(chosen), _BLOCK):
        part = chosen[start : start + _BLOCK]
        u, v = map(torch.from_numpy, table.in_panorama(part))
        if nearest:
            target[part] = source[nearest_equirect_index(u, v, shape).numpy()]
            continue
        index, weight = bilinear_equirect_taps(u.double(), v.double(), shape)
        values = np.einsum("tpc,tp->pc", source[index.numpy()], weight.numpy())
        target[part] = np.rint(values) if image.dtype.kind in "ui" else values


class Taps(NamedTuple):
    """Sources and weights of P values, each a sum of T terms.

    Attributes:
        source: ``(T, P)`` int64, flat indices into the source.
        weight: ``(T, P)`` floating-point weights.
    """

    source: Tensor
    weight: Tensor


def bilinear_equirect_taps(u: Tensor, v: Tensor, shape: tuple[int, int]) -> Taps:
    """Return bilinear taps at positions in an ERP.

    Beyond a pole the row reflects, rotated by half a revolution. With an odd width that falls
    between two columns, so the two rows have separate columns and weights.

    Args:
        u: ``(P,)`` columns, any real number.
        v: ``(P,)`` rows in [−½, H − ½].
        shape: ``(H, W)``.

    Returns:
        Four taps per position, weights of the dtype of `u`.
    """
    height, width = shape
    top = v.floor()
    indices, weights = [], []
    for row, row_weight in ((top, 1 - (v - top)), (top + 1, v - top)):
        reflected = torch.where(
            row < 0, -1 - row, torch.where(row < height, row, 2 * height - 1 - row)
        )
        column = torch.where(reflected == row, u, u + width / 2)
        left = column.floor()
        start = reflected.long() * width
        indices += [start + left.long() % width, start + (left.long() + 1) % width]
        weights += [row_weight * (1 - (column - left)), row_weight * (column - left)]
    return Taps(torch.stack(indices), torch.stack(weights))


def nearest_equirect_index(u: Tensor, v: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return the nearest pixel at positions in an ERP; half-way between two, the even one.

    Args:
        u: ``(P,)`` columns, any real number.
        v: ``(P,)`` rows in [−½, H − ½].
        shape: ``(H, W)``.

    Returns:
        ``(P,)`` int64 flat indices.
    """
    height, width = shape
    row = v.round().long().clamp(0, height - 1)
    return row * width + u.round().long() % width


def image_taps(
    face: Tensor,
    u: Tensor,
    v: Tensor,
    size: tuple[int, int],
    weight: Tensor,
    values: int,
) -> Taps:
    """Return bilinear taps in tangent images, clamped to the outermost pixel centers.

    Args:
        face: ``(R, P)`` indices of images, any integer dtype.
        u: ``(R, P)`` columns in the images.
        v: ``(R, P)`` rows in the images.
        size: Rows and columns of the images.
        weight: ``(R, P)`` weights of the images.
        values: Number of values from one image to the next in the flat source.

    Returns:
        4 R taps per position, weights of the dtype of `u`.
    """
    rows, columns = size
    left = u.floor().clamp(0, columns - 2)
    top = v.floor().clamp(0, rows - 2)
    right, below = (u - left).clamp(0, 1), (v - top).clamp(0, 1)
    first = face.long() * values + top.long() * columns + left.long()
    index = torch.cat([first, first + 1, first + columns, first + columns + 1])
    above, before = 1 - below, 1 - right
    weights = [above * before, above * right, below * before, below * right]
    return Taps(index, torch.cat([part * weight for part in weights]))


def nearest_image_index(face: Tensor, u: Tensor, v: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the nearest pixel at positions in images; half-way between two, the even one.

    Args:
        face: ``(P,)`` indices of images, any integer dtype.
        u: ``(P,)`` columns in the images.
        v: ``(P,)`` rows in the images.
        size: Rows and columns of the images.

    Returns:
        ``(P,)`` int64 flat indices into ``(N, h, w)``.
    """
    row, column = (
        line.round().long().clamp(0, side - 1) for line, side in zip((v, u), size, strict=True)
    )
    return (face.long() * size[0] + row) * size[1] + column


def sample(source: Tensor, taps: Taps) -> Tensor:
    """Return weighted sums of taps, differentiable with respect to the source.

    Args:
        source: ``(S, M)`` values; taps index the columns.
        taps: T taps for P positions.

    Returns:
        ``(S, P)`` sums of the dtype of the source, computed in the wider dtype of values and
        weights.
    """
    # gather, not index_select: its gradient is ten times faster on a CPU.
    size = (len(source), taps.source.shape[1])
    total = source.gather(1, taps.source[0].expand(size)) * taps.weight[0]
    for index, weight in zip(taps.source[1:], taps.weight[1:], strict=True):
        total = total + source.gather(1, index.expand(size)) * weight
    return total.to(source.dtype)
