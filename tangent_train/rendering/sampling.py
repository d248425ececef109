"""Positions in panoramas, and values at them.

The ray of pixel (i, j) of a panorama or image is
``(rows[i, 0] columns[0, j], rows[i, 0] columns[1, j], rows[i, 1])``, with the factors of
`sphere_rays` or `plane_rays`.

Arrays are sampled by `sample_map`, tensors by `sample_tensor`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

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


def positions_of_rays(
    matrices: NDArray[np.float64],
    rays: Rays,
    shape: tuple[int, int],
    dtype: np.dtype[np.floating],
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the positions in an ERP of the rays of n canvases, stacked vertically.

    Args:
        matrices: ``(n, 3, 3)`` from the rays of each canvas to directions of any length.
        rays: Rays of a canvas of ``(h, w)`` pixels.
        shape: ``(H, W)`` of the ERP.
        dtype: float32 or float64; the computation is float64 in both cases.

    Returns:
        Columns in [−½, W − ½] and rows in [−½, H − ½], ``(n h, w)``.
    """
    columns, rows = rays
    u, v = np.empty((2, len(matrices) * len(rows), columns.shape[1]), dtype)
    over_rows(_write_positions, *u.shape, np.ascontiguousarray(matrices), *rays, *shape, u, v)
    return u, v


@njit_exact
def _write_positions(
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
    is_nearest = interpolation == "nearest"
    if is_nearest:
        plain = _SAME_SIZE[image.dtype.itemsize]
        image, out = image.view(plain), out.view(plain)
    top, bottom, left, right = table.part.tolist()
    part = image[top:bottom, left:right]
    if right > image.shape[1]:
        part = np.concatenate([part, image[top:bottom, : right - image.shape[1]]], axis=1)
    is_small = max(*part.shape[:2], *table.u.shape) < _REMAP_LIMIT
    if is_small and (is_nearest or image.dtype in _REMAP_BILINEAR):
        _remap(table, part, is_nearest, out)
    elif is_nearest:
        row = np.rint(table.v).astype(np.intp).clip(0, len(part) - 1)
        out[:] = part[row, np.rint(table.u).astype(np.intp) % part.shape[1]]
    else:
        out[:] = _interpolated(part, table.u, table.v)
    if not is_nearest and len(table.polar):
        _write_polar(table, image, out)


def _remap(
    table: EquirectMap, part: NDArray[np.generic], is_nearest: bool, out: NDArray[np.generic]
) -> None:
    """Sample a part of a panorama with `cv2.remap`."""
    # Copying the part row by row takes less time than waiting for memory at every position.
    is_copied = part.dtype.itemsize < 4 and part.nbytes <= _COPIED * table.u.size
    u, v = (line.astype(np.float32, copy=False) for line in table[:2])
    if is_nearest and len(table.polar):
        v = v.clip(0, len(part) - 1)
    flag = cv2.INTER_NEAREST if is_nearest else cv2.INTER_LINEAR
    channels = 1 if part.ndim == 2 else part.shape[2]
    is_padded = is_copied and channels % 3 == 0 and not is_nearest
    if part.ndim == 2 or (channels in (3, 4) and not is_padded):
        part = np.ascontiguousarray(part) if is_copied else part
        cv2.remap(part, u, v, flag, dst=out, borderMode=cv2.BORDER_WRAP)
        return
    # cv2 is fastest with 4 channels. It refuses more than 4, or rounds their positions.
    several = 3 if channels % 3 == 0 else 1
    for first in range(0, channels, several):
        group = part[..., first : first + several]
        if is_padded:
            group = cv2.cvtColor(group, cv2.COLOR_RGB2RGBA)
        sampled = cv2.remap(group, u, v, flag, borderMode=cv2.BORDER_WRAP)
        if is_padded:
            sampled = cv2.cvtColor(sampled, cv2.COLOR_RGBA2RGB)
        out[..., first : first + several] = sampled.reshape(*out.shape[:2], several)


def _write_polar(table: EquirectMap, image: NDArray[np.generic], out: NDArray[np.generic]) -> None:
    """Sample positions next to the poles, where cv2 would continue at the other pole."""
    u, v = (line.reshape(-1)[table.polar].astype(np.float64) for line in table[:2])
    v += table.part[0]
    v = np.where(v < 0, v, v - (len(image) - 2))
    values = _interpolated(image[[0, -1]], u + table.part[2], v)
    out.reshape(table.u.size, -1)[table.polar] = values.reshape(len(u), -1)


def _interpolated(image: NDArray[Any], u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
    """Return float64 values ``(…[, C])`` of a whole or partial panorama ``(H, W[, C])``."""
    shape = image.shape[:2]
    planes = np.moveaxis(image.reshape(*shape, -1), -1, 0).astype(np.float64)
    columns, rows = (torch.from_numpy(line.reshape(-1)).double() for line in (u, v))
    values = sample_tensor(torch.from_numpy(planes), columns, rows).numpy().T
    values = np.rint(values) if image.dtype.kind in "ui" else values
    return values.reshape(*u.shape, *image.shape[2:])


def sample_tensor(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Interpolate a panorama bilinearly, differentiably on any device.

    Longitude wraps. A row beyond a pole is the reflected row, shifted by half a revolution.

    Args:
        image: ``(C, H, W)`` floating-point values.
        u: ``(P,)`` columns in [−1, 2 W].
        v: ``(P,)`` rows in [−½, H − ½].

    Returns:
        ``(C, P)`` values of the dtype of the image.
    """
    height, width = image.shape[-2:]
    planes = image if image.dtype == torch.float64 else image.float()
    beyond = [_half_revolution(planes[:, [row]]) for row in (0, -1)]
    tall = torch.cat([beyond[0], planes, beyond[1]], dim=1)
    padded = torch.cat([tall[..., -1:], tall, tall[..., :1]], dim=2)
    x = (2 * torch.where(u < width, u, u - width) + 3) / (width + 2) - 1
    positions = torch.stack([x, (2 * v + 3) / (height + 2) - 1], dim=-1)[None, None]
    with torch.autocast(image.device.type, enabled=False):
        values = grid_sample(
            padded[None], positions.to(planes.dtype), padding_mode="border", align_corners=False
        )
    return values[0, :, 0].to(image.dtype)


def _half_revolution(row: Tensor) -> Tensor:
    """Return a row ``(C, 1, W)`` rotated by 180°; means of two columns if W is odd."""
    width = row.shape[-1]
    return (row.roll(width // 2, -1) + row.roll((width + 1) // 2, -1)) / 2


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
