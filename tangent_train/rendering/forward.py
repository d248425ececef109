"""Render panoramas to tangent images, and to rotated panoramas."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tangent_train.geometry import PinholeGrid, checked_rotation
from tangent_train.geometry.grids import Faces
from tangent_train.rendering.checks import check_panorama
from tangent_train.rendering.sampling import (
    EquirectMap,
    map_dtype,
    nearest_equirect_index,
    positions_of_rays,
    sample_map,
    sample_tensor,
    sphere_rays,
)
from tangent_train.rendering.tables import Positions, forward_map, forward_positions

Interpolation = Literal["bilinear", "nearest"]

Pixels = TypeVar("Pixels", Tensor, NDArray[Any])
"""A tensor or an array; results are of the same kind."""

_TOGETHER = 2**16
"""Number of pixels sampled in one call: small images are grouped, to save calls."""


def equirect_to_tangent(
    image: Pixels,
    grid: PinholeGrid,
    faces: Faces | None = None,
    interpolation: Interpolation = "bilinear",
) -> Pixels:
    """Render tangent images from a panorama (paper, section 3.2).

    Longitude wraps and rows reflect at the poles, for every interpolation. A panorama of another
    aspect ratio than 2:1 is treated as a stretched image of the whole sphere.

    Args:
        image: A tensor ``(..., C, H, W)`` on any device, differentiable; or an array
            ``(H, W[, C])``: uint8, uint16 and float32 are sampled by `cv2.remap` (see `sample_map`
            for its precision), other dtypes are slower.
        grid: Geometry of the images, a `TangentGrid` or a `CubeGrid`.
        faces: Indices of the images to render, by default all.
        interpolation: ``bilinear``, or ``nearest`` for labels and masks of any dtype.

    Returns:
        A tensor ``(..., n, C, h, w)`` or an array ``(n, h, w[, C])``, of the dtype of the image.

    Raises:
        SettingError: The panorama, a face or the interpolation cannot be used.
    """
    check_panorama(image, interpolation)
    indices, (rows, columns) = grid.face_indices(faces), grid.size
    # For random subsets of images, tables are cached per image: subsets rarely repeat.
    is_together = faces is None or grid.rotation is not None
    if isinstance(image, Tensor):
        step = len(indices) if is_together else 1
        positions = [
            forward_positions(grid, image, part, interpolation)
            for part in np.split(indices, range(step, len(indices), max(1, step)))
        ]
        u, v = (torch.cat(lines) for lines in zip(*positions, strict=True))
        values = _sampled(image, (u, v), interpolation)
        return values.unflatten(-1, (len(indices), rows, columns)).movedim(-3, -4)
    image = np.ascontiguousarray(image)
    step = max(1, _TOGETHER // max(rows * columns, 4 * rows)) if is_together else 1
    out = np.empty((len(indices) * rows, columns, *image.shape[2:]), image.dtype)
    dtype = map_dtype(image.dtype == np.float64, interpolation)
    for start in range(0, len(indices), step):
        faces = indices[start : start + step]
        table = forward_map(grid, (image.shape[0], image.shape[1]), faces, dtype)
        sample_map(table, image, interpolation, out[start * rows : (start + step) * rows])
    return out.reshape(len(indices), rows, *out.shape[1:])


def _sampled(image: Tensor, positions: Positions, interpolation: Interpolation) -> Tensor:
    """Return values ``(..., P)`` of a panorama ``(..., H, W)`` at P columns and rows."""
    u, v = positions
    shape = image.shape[-2], image.shape[-1]
    if interpolation == "nearest":
        return image.flatten(-2)[..., nearest_equirect_index(u, v, shape)]
    return sample_tensor(image.reshape(-1, *shape), u, v).reshape(*image.shape[:-2], -1)


def rotate_equirect(
    image: Pixels, rotation: ArrayLike, interpolation: Interpolation = "bilinear"
) -> Pixels:
    """Rotate a panorama: direction d of the result shows the input at Rᵀd.

    Args:
        image: An array ``(H, W[, C])`` or a tensor ``(..., C, H, W)``, as for
            `equirect_to_tangent`.
        rotation: ``(3, 3)`` rotation R.
        interpolation: ``bilinear`` or ``nearest``.

    Returns:
        The rotated panorama, of the same shape and dtype.

    Raises:
        SettingError: The panorama, the rotation or the interpolation cannot be used.
    """
    check_panorama(image, interpolation)
    rotated = checked_rotation(rotation).tobytes()
    is_exact = image.dtype in (torch.float64, np.float64)
    height, width = image.shape[-2:] if isinstance(image, Tensor) else image.shape[:2]
    table = _rotation_map(rotated, (height, width), map_dtype(is_exact, interpolation))
    if isinstance(image, Tensor):
        u, v = (torch.from_numpy(line.ravel()).to(image.device) for line in table[:2])
        return _sampled(image, (u, v), interpolation).reshape(image.shape)
    out = np.empty_like(image, order="C")
    sample_map(table, np.ascontiguousarray(image), interpolation, out)
    return out


@lru_cache(maxsize=1)
def _rotation_map(
    rotation: bytes, shape: tuple[int, int], dtype: np.dtype[np.floating]
) -> EquirectMap:
    """Return source positions of all pixels; cached for the depth and labels of a panorama."""
    inverse = np.frombuffer(rotation).reshape(1, 3, 3).transpose(0, 2, 1)
    return EquirectMap.of(*positions_of_rays(inverse, sphere_rays(shape), shape, dtype), shape)
