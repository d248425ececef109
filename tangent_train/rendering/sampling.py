"""Sampling of NumPy panoramas, the one mechanism of all renderers that take them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tangent_train.rendering.kernels import pinhole_map
from tangent_train.rendering.taps import bilinear_equirect_taps, nearest_equirect_index
from tangent_train.rendering.threads import over_rows

__all__ = ["EquirectMap", "map_dtype", "pinhole_equirect_map"]

_REMAP_LIMIT = 32767
"""cv2.remap takes images whose sides are below SHRT_MAX."""
_REMAP_BILINEAR = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
_SAME_SIZE = {1: np.uint8, 2: np.uint16, 4: np.float32, 8: np.float64}
"""Nearest sampling moves bytes: any dtype goes as one of its size that cv2 knows."""
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

    @property
    def nbytes(self) -> int:
        """Memory of the tables."""
        return self.u.nbytes + self.v.nbytes + self.polar.nbytes

    def sample(
        self, image: NDArray[np.generic], interpolation: str, out: NDArray[np.generic]
    ) -> None:
        """Sample a panorama, longitude wrapped and poles reflected.

        Bilinear sampling of uint8, uint16 and float32 is done by `cv2.remap`. OpenCV 5 computes
        with exact positions and rounds integers once; OpenCV 4 may round positions to 1/32 pixel,
        which 8-bit images do not show. All else is exact.

        Args:
            image: ``(H, W[, C])``.
            interpolation: ``bilinear`` or ``nearest``.
            out: ``(h, w[, C])`` contiguous, same dtype, written.
        """
        if max(*self.shape, *self.u.shape) >= _REMAP_LIMIT:
            self._gather(image, interpolation, out, None)
        elif interpolation == "nearest":
            plain = _SAME_SIZE[image.dtype.itemsize]
            rows = self.v.clip(0, self.shape[0] - 1) if len(self.polar) else self.v
            self._remap(image.view(plain), rows, cv2.INTER_NEAREST, out.view(plain))
        elif image.dtype in _REMAP_BILINEAR:
            self._remap(image, self.v, cv2.INTER_LINEAR, out)
            if len(self.polar):
                self._gather(image, interpolation, out, self.polar)
        else:
            self._gather(image, interpolation, out, None)

    def _remap(
        self,
        image: NDArray[np.generic],
        v: NDArray[np.floating],
        flag: int,
        out: NDArray[np.generic],
    ) -> None:
        u, v = self.u.astype(np.float32, copy=False), v.astype(np.float32, copy=False)
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

    def _gather(
        self,
        image: NDArray[np.generic],
        interpolation: str,
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
            if interpolation == "nearest":
                target[part] = source[nearest_equirect_index(u, v, self.shape).numpy()]
                continue
            index, weight = bilinear_equirect_taps(u.double(), v.double(), self.shape)
            values = np.einsum("tpc,tp->pc", source[index.numpy()], weight.numpy())
            target[part] = np.rint(values) if image.dtype.kind in "ui" else values


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
