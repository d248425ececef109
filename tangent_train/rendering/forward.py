"""Render panoramas to tangent images, and to rotated panoramas."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tangent_train.geometry import PinholeGrid, checked_rotation
from tangent_train.geometry.pinhole_grid import Faces
from tangent_train.rendering.checks import check_panorama
from tangent_train.rendering.sampling import (
    EquirectMap,
    bilinear_equirect_taps,
    equirect_map,
    map_dtype,
    nearest_equirect_index,
    sample,
    sample_map,
    sphere_rays,
)
from tangent_train.rendering.tables import forward_map, forward_positions, tensors_on

Interpolation = Literal["bilinear", "nearest"]

Pixels = TypeVar("Pixels", Tensor, NDArray[Any])
"""A tensor or an array; results are of the same kind."""

_CHUNK = 2**20
"""Number of positions whose taps torch holds at once."""

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
    indices = grid.face_indices(faces)
    # For random subsets of images, tables are cached per image: subsets rarely repeat.
    together = faces is None or grid.rotation is not None
    pixels = _CHUNK if isinstance(image, Tensor) else _TOGETHER
    rows, columns = grid.size
    step = max(1, pixels // max(rows * columns, 4 * rows)) if together else 1
    if isinstance(image, Tensor):
        return _render_tensor(image, grid, indices, step, interpolation)
    image = np.ascontiguousarray(image)
    shape = image.shape[0], image.shape[1]
    out = np.empty((len(indices) * rows, columns, *image.shape[2:]), image.dtype)
    dtype = map_dtype(image.dtype == np.float64, interpolation)
    for start in range(0, len(indices), step):
        table = forward_map(grid, shape, indices[start : start + step], dtype)
        part = out[start * rows : (start + step) * rows]
        sample_map(table, image, interpolation, part)
    return out.reshape(len(indices), rows, *out.shape[1:])


def _render_tensor(
    image: Tensor,
    grid: PinholeGrid,
    indices: NDArray[np.int64],
    step: int,
    interpolation: Interpolation,
) -> Tensor:
    *batch, channels, height, width = image.shape
    source = image.reshape(-1, height * width)
    dtype = map_dtype(image.dtype == torch.float64, interpolation)
    chunks = [image.new_empty((*batch, 0, channels, *grid.size))]
    rows, columns = grid.size
    at_once = max(step, _CHUNK // (rows * columns))  # on a GPU, many small calls take longer
    for start in range(0, len(indices), at_once):
        faces = indices[start : start + at_once].tolist()
        tables = []
        for first in range(0, len(faces), step):
            part = tuple(faces[first : first + step])
            # On the CPU the map itself is already cached.
            key = None if image.device.type == "cpu" else ("forward", (height, width), part, dtype)
            build = partial(forward_positions, grid, (height, width), part, dtype)
            tables.append(tensors_on(image.device, grid, key, build))
        u, v = (torch.cat(lines) for lines in zip(*tables, strict=True))
        values = _sampled(source, u, v, (height, width), interpolation)
        images = values.reshape(*batch, channels, len(faces), *grid.size)
        chunks.append(images.movedim(-3, -4))
    return torch.cat(chunks, dim=-4)


def _sampled(
    source: Tensor, u: Tensor, v: Tensor, shape: tuple[int, int], interpolation: Interpolation
) -> Tensor:
    """Return values ``(S, P)`` of a source ``(S, H W)`` at P columns and rows."""
    if interpolation == "nearest":
        index = nearest_equirect_index(u, v, shape)
        return source.gather(1, index.expand(len(source), -1))
    return sample(source, bilinear_equirect_taps(u, v, shape))


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
    if isinstance(image, Tensor):
        shape = image.shape[-2], image.shape[-1]
        dtype = map_dtype(image.dtype == torch.float64, interpolation)
        positions = _rotation_map(rotated, shape, dtype).in_panorama()
        on_device = (torch.from_numpy(line).to(image.device) for line in positions)
        u, v = (torch.split(line, _CHUNK) for line in on_device)
        source = image.reshape(-1, shape[0] * shape[1])
        parts = [_sampled(source, *at, shape, interpolation) for at in zip(u, v, strict=True)]
        return torch.cat(parts, dim=1).reshape(image.shape)
    dtype = map_dtype(image.dtype == np.float64, interpolation)
    table = _rotation_map(rotated, (image.shape[0], image.shape[1]), dtype)
    out = np.empty_like(image, order="C")
    sample_map(table, np.ascontiguousarray(image), interpolation, out)
    return out


@lru_cache(maxsize=1)
def _rotation_map(
    rotation: bytes, shape: tuple[int, int], dtype: np.dtype[np.floating]
) -> EquirectMap:
    """Return source positions of all pixels; cached for the depth and labels of a panorama."""
    inverse = np.frombuffer(rotation).reshape(1, 3, 3).transpose(0, 2, 1)
    return equirect_map(inverse, sphere_rays(shape), shape, dtype)
