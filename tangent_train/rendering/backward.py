"""From tangent images back to the panorama."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, TypeVar, overload

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.geometry import PinholeGrid
from tangent_train.rendering import feather_kernels, label_kernels
from tangent_train.rendering.checks import (
    check_blend,
    check_images_array,
    check_nearest,
    check_scores,
    check_shape,
    check_tangent_images,
)
from tangent_train.rendering.feathering import feather_arrays
from tangent_train.rendering.forward import Interpolation
from tangent_train.rendering.sampling import map_dtype
from tangent_train.rendering.tables import (
    feather_arguments,
    feather_table,
    owner_arguments,
    owner_table,
    tensors_on,
)
from tangent_train.rendering.taps import Taps, image_taps, nearest_image_index, sample
from tangent_train.rendering.threads import over_rows

__all__ = ["Blend", "tangent_to_equirect", "tangent_to_labels"]

Blend = Literal["nearest", "feather"]

Scalar = TypeVar("Scalar", bound=np.generic)

_BAND = 2**20
"""Pixels whose taps torch holds at once."""


@overload
def tangent_to_equirect(
    images: Tensor,
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend = "nearest",
    interpolation: Interpolation = "bilinear",
) -> Tensor: ...
@overload
def tangent_to_equirect(
    images: NDArray[Scalar],
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend = "nearest",
    interpolation: Interpolation = "bilinear",
) -> NDArray[Scalar]: ...
def tangent_to_equirect(
    images: Tensor | NDArray[Scalar],
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend = "nearest",
    interpolation: Interpolation = "bilinear",
) -> Tensor | NDArray[Scalar]:
    """Render tangent images back to a panorama.

    Args:
        images: All images of the grid: a floating-point tensor ``(..., N, C, d, d)`` on any
            device, differentiable; or an array ``(N, d, d[, C])`` of numbers.
        grid: The images' geometry.
        shape: ``(H, W)`` of the panorama.
        blend: ``nearest``: every direction is taken from its owner. ``feather``: the average of
            all images that see it, weights falling to 0 at the images' borders: no seams. Only
            for images that overlap, not for a cube's.
        interpolation: ``bilinear``, or ``nearest`` for labels, masks and depth of any dtype: the
            owner's pixel whose centre is nearest, kept exactly. Only with the blend ``nearest``.

    Returns:
        A tensor ``(..., C, H, W)`` or an array ``(H, W[, C])``, of the dtype of the images.

    Raises:
        SettingError: The images, the shape, the blend or the interpolation cannot be used.
    """
    check_blend(blend, grid)
    height, width = check_shape(shape)
    if interpolation != "bilinear":
        check_nearest(images, grid, blend, interpolation)
        return _nearest(images, grid, (height, width))
    if isinstance(images, np.ndarray):
        return _from_arrays(images, grid, (height, width), blend)
    check_tangent_images(images, grid)
    channels, size = images.shape[-3], grid.dim**2
    flat = images.movedim(-4, -3).reshape(-1, grid.num_images * size)
    bands = [sample(flat, taps) for taps in _bands(images, grid, (height, width), blend, size)]
    return torch.cat(bands, dim=1).reshape(*images.shape[:-4], channels, height, width)


def _nearest(
    images: Tensor | NDArray[Scalar], grid: PinholeGrid, shape: tuple[int, int]
) -> Tensor | NDArray[Scalar]:
    """The owner's pixel whose centre is nearest, for every pixel of the panorama."""
    # Positions are float32 for all dtypes, so that all take the same pixel.
    table = owner_table(grid, shape, map_dtype(False, "nearest"))
    face, u, v = (torch.from_numpy(part.reshape(-1)) for part in table.arrays)
    bands = [slice(start, start + _BAND) for start in range(0, len(face), _BAND)]
    indices = (nearest_image_index(face[band], u[band], v[band], grid.dim) for band in bands)
    size = grid.num_images * grid.dim**2
    if isinstance(images, np.ndarray):
        pixels = images.reshape(size, *images.shape[3:])
        taken = np.concatenate([pixels[index.numpy()] for index in indices])
        return taken.reshape(*shape, *images.shape[3:])
    flat = images.movedim(-4, -3).reshape(-1, size)
    on_device = (index.to(images.device).expand(len(flat), -1) for index in indices)
    parts = [flat.gather(1, index) for index in on_device]
    return torch.cat(parts, dim=1).reshape(*images.shape[:-4], images.shape[-3], *shape)


@overload
def tangent_to_labels(
    logits: Tensor, grid: PinholeGrid, shape: tuple[int, int], blend: Blend = "nearest"
) -> Tensor: ...
@overload
def tangent_to_labels(
    logits: NDArray[np.floating],
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend = "nearest",
) -> NDArray[np.unsignedinteger]: ...
def tangent_to_labels(
    logits: Tensor | NDArray[np.floating],
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend = "nearest",
) -> Tensor | NDArray[np.unsignedinteger]:
    """Class of the largest bilinear score at every pixel of the panorama.

    Rendering and argmax are one step: the scores of the panorama, ``(K, H, W)``, are never held.
    float32 scores on the CPU, and all but float64 or blended ones on a GPU, are rendered by a
    compiled kernel, others by torch.

    Args:
        logits: ``(..., N, K, d, d)`` floating-point scores of all images of the grid.
        grid: The images' geometry.
        shape: ``(H, W)`` of the panorama.
        blend: ``nearest``: the owner's scores. ``feather``: the average of all images that see a
            direction, weighted as in `tangent_to_equirect`; meant for softmax scores.

    Returns:
        ``(..., H, W)`` class indices; of equal scores the first class, and NaN never wins. An int64
        tensor on the device of the logits, or an array, uint8 up to 256 classes and uint16 above.

    Raises:
        SettingError: The logits, the shape or the blend cannot be used.
    """
    check_blend(blend, grid)
    height, width = check_shape(shape)
    if isinstance(logits, np.ndarray):
        return _render_labels(_tensor(logits), grid, (height, width), blend).numpy()
    return _render_labels(logits.detach(), grid, (height, width), blend).long()


def _render_labels(
    logits: Tensor, grid: PinholeGrid, shape: tuple[int, int], blend: Blend
) -> Tensor:
    """`tangent_to_labels` in the smallest unsigned integers."""
    check_scores(logits, grid)
    small = torch.uint8 if logits.shape[-3] <= 256 else torch.uint16
    stacks = logits.reshape(-1, *logits.shape[-4:])
    compiled = logits.device.type == "cpu" and logits.dtype == torch.float32
    render = _compiled_labels if compiled and grid.dim >= label_kernels.LANES else _torch_labels
    result = torch.empty((len(stacks), *shape), dtype=small, device=logits.device)
    for stack, labels in zip(stacks, result, strict=True):
        render(stack, grid, blend, labels)
    return result.reshape(*logits.shape[:-4], *shape)


def _tensor(array: NDArray[Any]) -> Tensor:
    """A tensor of the same memory; torch warns about arrays that may not be written."""
    array = np.ascontiguousarray(array)
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def _from_arrays(
    images: NDArray[Scalar], grid: PinholeGrid, shape: tuple[int, int], blend: Blend
) -> NDArray[Scalar]:
    """`tangent_to_equirect` of arrays ``(N, d, d[, C])``; integers are rounded."""
    exact = (images.dtype.kind in "ui" and images.dtype.itemsize > 2) or images.dtype == np.float64
    if blend == "feather" and not exact:
        check_images_array(images, grid)
        stacked = images if images.ndim == 4 else images[..., None]
        return feather_arrays(stacked, grid, shape).reshape(*shape, *images.shape[3:])
    stack = _tensor(images.astype(np.float64 if exact else np.float32, copy=False))
    stack = stack[:, None] if images.ndim == 3 else stack.movedim(-1, 1)
    result = tangent_to_equirect(stack, grid, shape, blend).movedim(0, -1).numpy()
    if images.ndim == 3:
        result = result[..., 0]
    if images.dtype.kind in "ui":
        result = np.rint(result)
    return np.ascontiguousarray(result, images.dtype)


def _bands(
    images: Tensor, grid: PinholeGrid, shape: tuple[int, int], blend: Blend, image_size: int
) -> Iterator[Taps]:
    """Taps of the panorama's rows, band by band."""
    dtype = map_dtype(images.dtype == torch.float64, "bilinear")
    height, width = shape
    step = max(1, min(height, _BAND // width))
    for start in range(0, height, step):
        rows = slice(start, min(height, start + step))

        def arrays(rows: slice = rows) -> tuple[NDArray[Any], ...]:
            if blend == "feather":
                return feather_table(grid, shape, dtype, rows).arrays
            return tuple(part[:, rows] for part in owner_table(grid, shape, dtype).arrays)

        kept = blend == "nearest" or step == height
        key = (blend, shape, dtype, rows.start, rows.stop)
        parts = tensors_on(images.device, grid, key if kept else None, arrays)
        face, u, v, *weight = (part.reshape(len(part), -1) for part in parts)
        yield image_taps(face, u, v, grid.dim, weight[0] if weight else None, image_size)


def _compiled_labels(scores: Tensor, grid: PinholeGrid, blend: Blend, labels: Tensor) -> None:
    """Labels ``(H, W)`` of ``(N, K, d, d)`` float32 scores on the CPU."""
    array, out = scores.contiguous().numpy(), labels.numpy()
    shape = check_shape(labels.shape)
    if blend == "feather":
        over_rows(
            feather_kernels.feather_labels, shape, array, *feather_arguments(grid, shape), out
        )
    else:
        over_rows(label_kernels.owner_labels, shape, array, *owner_arguments(grid, shape), out)


def _torch_labels(scores: Tensor, grid: PinholeGrid, blend: Blend, labels: Tensor) -> None:
    """Labels ``(H, W)`` of ``(N, K, d, d)`` scores of any device and dtype, class by class."""
    num_classes, size = scores.shape[1], grid.dim**2
    flat = scores.reshape(1, -1)
    start = 0
    for source, weight in _bands(
        scores, grid, check_shape(labels.shape), blend, num_classes * size
    ):
        label = source.new_zeros((1, source.shape[-1]))
        best = torch.full_like(label, -torch.inf, dtype=scores.dtype)
        for k in range(num_classes):
            score = sample(flat, Taps(source + k * size, weight))
            label.masked_fill_(score > best, k)
            best = torch.fmax(best, score)
        labels.view(-1)[start : start + label.shape[1]] = label[0].to(labels.dtype)
        start += label.shape[1]
