"""Sampling of NumPy panoramas, the one mechanism of all renderers that take them."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tangent_train.rendering.compiled import over_rows
from tangent_train.rendering.rays import Rays, equirect_positions, plane_rays
from tangent_train.rendering.taps import bilinear_equirect_taps, nearest_equirect_index

_REMAP_LIMIT = 32767
"""cv2.remap takes images whose sides are below SHRT_MAX."""
_REMAP_BILINEAR = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
_SAME_SIZE = {1: np.uint8, 2: np.uint16, 4: np.float32, 8: np.float64}
"""Nearest sampling moves bytes: any dtype goes as one of its size."""
_BLOCK = 2**18
"""Positions sampled at once where cv2 cannot be used."""


def map_dtype(exact: bool, interpolation: str) -> np.dtype[np.floating]:
    """Precision of positions: float64 where `exact`, except that nearest is the same for all."""
    return np.dtype(np.float64 if exact and interpolation == "bilinear" else np.float32)


class EquirectMap(NamedTuple):
    """Positions in an ERP.

    Attributes:
        u: ``(h, w)`` columns in [−½, W − ½], float32 or float64.
        v: ``(h, w)`` rows in [−½, H − ½], same dtype.
        polar: Flat indices of positions between a pole and the row next to it.
    """

    u: NDArray[np.floating]
    v: NDArray[np.floating]
    polar: NDArray[np.intp]


def sample_map(
    table: EquirectMap,
    image: NDArray[np.generic],
    interpolation: str,
    out: NDArray[np.generic],
) -> None:
    """Sample a panorama, longitude wrapped and poles reflected.

    uint8, uint16 and float32, and the nearest pixel of anything, are sampled by `cv2.remap`. OpenCV
    4 may round positions to 1/32 pixel, which is invisible in 8-bit images; OpenCV 5 does not. All
    other sampling is exact.

    Args:
        table: Positions ``(h, w)`` in the panorama.
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
    if not nearest and len(table.polar):  # cv2 would go on at the other pole
        _gather(table, image, nearest, out, table.polar)


def _remap(
    table: EquirectMap, image: NDArray[np.generic], nearest: bool, out: NDArray[np.generic]
) -> None:
    u, v = (line.astype(np.float32, copy=False) for line in table[:2])
    if nearest and len(table.polar):
        v = v.clip(0, len(image) - 1)
    flag = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    channels = 1 if image.ndim == 2 else image.shape[2]
    if image.ndim == 2 or channels in (3, 4):
        cv2.remap(image, u, v, flag, dst=out, borderMode=cv2.BORDER_WRAP)
        return
    # Other numbers of channels cv2 refuses, or samples at rounded positions.
    several = 3 if channels % 3 == 0 else 1
    for first in range(0, channels, several):
        group = np.ascontiguousarray(image[..., first : first + several])
        sampled = cv2.remap(group, u, v, flag, borderMode=cv2.BORDER_WRAP)
        out[..., first : first + several] = sampled.reshape(*out.shape[:2], several)


def _gather(
    table: EquirectMap,
    image: NDArray[np.generic],
    nearest: bool,
    out: NDArray[np.generic],
    chosen: NDArray[np.intp],
) -> None:
    """Sample the chosen positions, with any dtype and size."""
    shape = image.shape[0], image.shape[1]
    source = image.reshape(shape[0] * shape[1], -1)
    target = out.reshape(table.u.size, -1)
    for start in range(0, len(chosen), _BLOCK):
        part = chosen[start : start + _BLOCK]
        u, v = (torch.from_numpy(line.reshape(-1)[part]) for line in table[:2])
        if nearest:
            target[part] = source[nearest_equirect_index(u, v, shape).numpy()]
            continue
        index, weight = bilinear_equirect_taps(u.double(), v.double(), shape)
        values = np.einsum("tpc,tp->pc", source[index.numpy()], weight.numpy())
        target[part] = np.rint(values) if image.dtype.kind in "ui" else values


def equirect_map(
    matrices: NDArray[np.float64],
    rays: Rays,
    shape: tuple[int, int],
    dtype: np.dtype[np.floating],
) -> EquirectMap:
    """Positions of rays in an ERP, of several canvases one below the other.

    Args:
        matrices: ``(n, 3, 3)`` from the rays of each canvas to directions of any length.
        rays: Of a canvas of ``(h, w)`` pixels, see `tangent_train.rendering.rays`.
        shape: ``(H, W)`` of the ERP.
        dtype: float32 or float64; computed in float64 either way.

    Returns:
        Positions ``(n h, w)``.
    """
    columns, rows = rays
    u, v = np.empty((2, len(matrices) * len(rows), columns.shape[1]), dtype)
    over_rows(equirect_positions, *u.shape, np.ascontiguousarray(matrices), *rays, *shape, u, v)
    return EquirectMap(u, v, np.flatnonzero((v < 0) | (v > shape[0] - 1)))


def pinhole_equirect_map(
    world_from_pixel: NDArray[np.float64],
    size: tuple[int, int],
    shape: tuple[int, int],
    dtype: np.dtype[np.floating],
) -> EquirectMap:
    """Positions of the pixels of pinhole images in an ERP, one image below the other.

    Args:
        world_from_pixel: ``(3, 3)`` or, of n images, ``(n, 3, 3)`` from homogeneous pixels (column,
            row, 1) to directions.
        size: ``(height, width)`` of each image.
        shape: ``(H, W)`` of the ERP.
        dtype: float32 or float64; computed in float64 either way.
    """
    matrices = world_from_pixel.reshape(-1, 3, 3)[..., [0, 2, 1]]
    return equirect_map(matrices, plane_rays(size), shape, dtype)
