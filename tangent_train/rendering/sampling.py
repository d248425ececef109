"""Sampling of NumPy panoramas, the one mechanism of all renderers that take them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tangent_train.rendering.kernels import pinhole_map
from tangent_train.rendering.sampling_kernels import sample_colors, sample_nearest
from tangent_train.rendering.taps import bilinear_equirect_taps, nearest_equirect_index
from tangent_train.rendering.threads import over_rows

__all__ = ["EquirectMap", "map_dtype", "pinhole_equirect_map", "sample_maps"]

Scalar = TypeVar("Scalar", bound=np.generic)

_KERNEL_LIMIT = 2**31
"""Compiled kernels take images of fewer values."""
_SMALLEST_SHARE = 2**18
"""Pixels that a kernel samples in about the time that starting a thread takes."""
_REMAP_LIMIT = 32767
"""cv2.remap takes images whose sides are below SHRT_MAX."""
_REMAP_BILINEAR = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
_COLORS = (np.dtype(np.uint8), np.dtype(np.float32))
"""Of three channels, sampled by a compiled kernel."""
_SAME_SIZE = {1: np.uint8, 2: np.uint16, 4: np.float32, 8: np.float64}
"""Nearest sampling moves bytes: any dtype goes as one of its size."""
_BLOCK = 2**18
"""Positions sampled at once where cv2 cannot be used."""


def map_dtype(exact: bool, interpolation: str) -> np.dtype[np.floating]:
    """Precision of positions: float64 where `exact`, except that nearest is the same for all."""
    return np.dtype(np.float64 if exact and interpolation == "bilinear" else np.float32)


@dataclass(frozen=True, eq=False)
class EquirectMap:
    """Positions in an ERP, ready for `cv2.remap`.

    Attributes:
        u: ``(h, w)`` columns in [−½, W − ½], float32 or float64.
        v: ``(h, w)`` rows in [−½, H − ½], same dtype.
        shape: ``(H, W)`` of the ERP.
    """

    u: NDArray[np.floating]
    v: NDArray[np.floating]
    shape: tuple[int, int]

    @cached_property
    def polar(self) -> NDArray[np.intp]:
        """Flat indices of positions between a pole and the row next to it."""
        return np.flatnonzero((self.v < 0) | (self.v > self.shape[0] - 1))

    @cached_property
    def positions(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """`u` and `v` for compiled kernels."""
        u, v = (np.ascontiguousarray(line, np.float32) for line in (self.u, self.v))
        return _read_only(u), _read_only(v)

    @property
    def nbytes(self) -> int:
        """Memory of the tables."""
        return self.u.nbytes + self.v.nbytes + self.polar.nbytes

    def sample(
        self, image: NDArray[np.generic], interpolation: str, out: NDArray[np.generic]
    ) -> None:
        """Sample a panorama at these positions; see `sample_maps`."""
        sample_maps([self], image, interpolation, out)

    def sample_by_cv2(
        self, image: NDArray[np.generic], nearest: bool, out: NDArray[np.generic]
    ) -> None:
        """The same without compiled kernels; nearest of dtypes of `_SAME_SIZE` only."""
        small = max(*self.shape, *self.u.shape) < _REMAP_LIMIT
        if not small or not (nearest or image.dtype in _REMAP_BILINEAR):
            self.gather(image, nearest, out, None)
            return
        self._remap(image, nearest, out)
        if not nearest and len(self.polar):
            self.gather(image, nearest, out, self.polar)

    def _remap(self, image: NDArray[np.generic], nearest: bool, out: NDArray[np.generic]) -> None:
        u, v = self.u.astype(np.float32, copy=False), self.v.astype(np.float32, copy=False)
        if nearest and len(self.polar):
            v = v.clip(0, self.shape[0] - 1)
        flag = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
        channels = 1 if image.ndim == 2 else image.shape[2]
        if image.ndim == 2 or channels in (3, 4):
            cv2.remap(image, u, v, flag, dst=out, borderMode=cv2.BORDER_WRAP)
            return
        # Other numbers of channels cv2 refuses, or samples at rounded positions.
        several = 3 if channels % 3 == 0 else 4
        for first in range(0, channels, several):
            group = image[..., first : first + several]
            size = group.shape[2]
            if size < 3:
                group = np.pad(group, ((0, 0), (0, 0), (0, 3 - size)))
            sampled = cv2.remap(np.ascontiguousarray(group), u, v, flag, borderMode=cv2.BORDER_WRAP)
            out[..., first : first + several] = sampled[..., :size]

    def gather(
        self,
        image: NDArray[np.generic],
        nearest: bool,
        out: NDArray[np.generic],
        chosen: NDArray[np.intp] | None,
    ) -> None:
        """Sample the chosen positions, default all, with any dtype and size."""
        source = image.reshape(self.shape[0] * self.shape[1], -1)
        target = out.reshape(self.u.size, -1)
        positions = np.arange(self.u.size) if chosen is None else chosen
        for start in range(0, len(positions), _BLOCK):
            part = positions[start : start + _BLOCK]
            u, v = (torch.from_numpy(line.reshape(-1)[part]) for line in (self.u, self.v))
            if nearest:
                target[part] = source[nearest_equirect_index(u, v, self.shape).numpy()]
                continue
            index, weight = bilinear_equirect_taps(u.double(), v.double(), self.shape)
            values = np.einsum("tpc,tp->pc", source[index.numpy()], weight.numpy())
            target[part] = np.rint(values) if image.dtype.kind in "ui" else values


def sample_maps(
    maps: Sequence[EquirectMap],
    image: NDArray[np.generic],
    interpolation: str,
    out: NDArray[np.generic],
) -> None:
    """Sample a panorama at many positions, longitude wrapped and poles reflected.

    Three channels of uint8 or float32, and the nearest pixel of one channel, are sampled by
    compiled kernels; other bilinear uint8, uint16 and float32 by `cv2.remap`. OpenCV 5 computes
    with exact positions and rounds integers once; OpenCV 4 may round positions to 1/32 pixel,
    which 8-bit images do not show. All else is exact.

    Args:
        maps: Positions ``(h, w)`` in the panorama; only the last may have other rows.
        image: ``(H, W[, C])``.
        interpolation: ``bilinear`` or ``nearest``.
        out: ``(h₁ + h₂ + …, w[, C])`` contiguous, same dtype, written.
    """
    nearest = interpolation == "nearest"
    if nearest:
        plain = _SAME_SIZE[image.dtype.itemsize]
        image, out = image.view(plain), out.view(plain)
    height = len(maps[0].u)
    parts = [out[n * height :][: len(table.u)] for n, table in enumerate(maps)]
    kernel = _kernel_for(image, nearest)
    if kernel is not None:
        _over_maps(kernel, maps, image, parts)
    for table, part in zip(maps, parts, strict=True):
        if kernel is None:
            table.sample_by_cv2(image, nearest, part)
        elif not nearest and len(table.polar):
            table.gather(image, nearest, part, table.polar)


def _kernel_for(image: NDArray[np.generic], nearest: bool) -> Callable[..., None] | None:
    """A compiled kernel that is faster than cv2, where there is one."""
    if image.size >= _KERNEL_LIMIT:
        return None
    if nearest and image.ndim == 2:
        return sample_nearest
    if not nearest and image.dtype in _COLORS and image.shape[2:] == (3,):
        return sample_colors
    return None


def _over_maps(
    kernel: Callable[..., None],
    maps: Sequence[EquirectMap],
    image: NDArray[np.generic],
    parts: Sequence[NDArray[np.generic]],
) -> None:
    """Run a kernel for all rows of all maps, as if they were one, in parallel."""
    height, width = maps[0].u.shape
    source = _read_only(image.reshape(-1))
    arguments = [(source, *table.positions) for table in maps]

    def of_rows(start: int, stop: int) -> None:
        for n in range(start // height, -(-stop // height)):
            above = n * height
            rows = max(start - above, 0), min(stop - above, len(maps[n].u))
            kernel(*rows, *maps[n].shape, *arguments[n], parts[n].reshape(-1))

    shape = sum(len(table.u) for table in maps), width
    over_rows(of_rows, shape, smallest_share=_SMALLEST_SHARE)


def _read_only(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Files can only be read: where all are so, a kernel is compiled once."""
    view = array.view()
    view.flags.writeable = False
    return view


def pinhole_equirect_map(
    world_from_pixel: NDArray[np.float64],
    size: tuple[int, int],
    shape: tuple[int, int],
    dtype: np.dtype[np.floating],
) -> EquirectMap:
    """Where the pixels of pinhole images are in an ERP, one image below the other.

    Args:
        world_from_pixel: ``(3, 3)`` or, of n images, ``(n, 3, 3)`` from homogeneous pixels (column,
            row, 1) to directions.
        size: ``(height, width)`` of each image.
        shape: ``(H, W)`` of the ERP.
        dtype: float32 or float64; computed in float64 either way.
    """
    height, width = size
    matrices = np.ascontiguousarray(world_from_pixel).reshape(-1, 3, 3)
    u, v = np.empty((2, len(matrices) * height, width), dtype)
    over_rows(pinhole_map, u.shape, matrices, *shape, u, v)
    return EquirectMap(u, v, shape)
