"""Render tangent images back to the panorama."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.geometry import PinholeGrid
from tangent_train.rendering.accumulate import NO_OWNERS, add_to_canvas, label_canvas, zero_sums
from tangent_train.rendering.checks import (
    Blend,
    blend_of,
    check_images,
    check_interpolation,
    check_shape,
)
from tangent_train.rendering.forward import Interpolation, Pixels
from tangent_train.rendering.representations.views import PinholeViews
from tangent_train.rendering.sampling import (
    Taps,
    image_taps,
    map_dtype,
    nearest_image_index,
    sample,
)
from tangent_train.rendering.tables import image_table, owners, tensors_on

_BAND = 2**20
"""Number of pixels whose taps or sums are held at once."""


def tangent_to_equirect(
    images: Pixels,
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend = "nearest",
    interpolation: Interpolation = "bilinear",
) -> Pixels:
    """Render tangent images back to a panorama.

    Args:
        images: All images of the grid: a floating-point tensor ``(..., N, C, h, w)`` on any
            device, differentiable; or an array ``(N, h, w[, C])`` of numbers.
        grid: The images' geometry.
        shape: ``(H, W)`` of the panorama.
        blend: ``nearest``: every direction is taken from its owner. ``feather``: the average of
            all images that cover it, with weights that fall to 0 at the images' borders, so that
            there are no seams. See `blend_of` for images that do not overlap.
        interpolation: ``bilinear``; or ``nearest`` for labels, masks and depth of any dtype, which
            copies the nearest pixel of the owner and needs the blend ``nearest``.

    Returns:
        A tensor ``(..., C, H, W)`` or an array ``(H, W[, C])``, of the dtype of the images.

    Raises:
        SettingError: The images, the shape, the blend or the interpolation cannot be used.
    """
    blend = blend_of(blend, is_overlapping=grid.is_overlapping)
    check_interpolation(interpolation, blend)
    shape = check_shape(shape)
    check_images("tangent images", images, grid, interpolation)
    if isinstance(images, np.ndarray):
        return _from_arrays(images, grid, shape, blend, interpolation)
    flat = images.movedim(-4, -3).reshape(-1, grid.num_images * math.prod(grid.size))
    # For the nearest pixel all dtypes use float32 positions, so that all take the same pixel.
    dtype = map_dtype(images.dtype == torch.float64, interpolation)
    bands = []
    for face, u, v, weight in _bands(images.device, grid, shape, blend, dtype):
        if interpolation == "nearest":
            index = nearest_image_index(face[0], u[0], v[0], grid.size)
            bands.append(flat.gather(1, index.expand(len(flat), -1)))
        else:
            bands.append(
                sample(flat, image_taps(face, u, v, grid.size, weight, math.prod(grid.size)))
            )
    return torch.cat(bands, dim=1).reshape(*images.shape[:-4], images.shape[-3], *shape)


def tangent_to_labels(
    logits: Pixels, grid: PinholeGrid, shape: tuple[int, int], blend: Blend = "nearest"
) -> Pixels:
    """Return the class of the largest bilinear score at every pixel of the panorama.

    Rendering and argmax are one step, so the scores of the panorama, ``(K, H, W)``, are not held in
    memory. On the CPU a compiled kernel works in float32; float64 scores and scores on a GPU are
    rendered by torch.

    Args:
        logits: ``(..., N, K, h, w)`` floating-point scores of all images of the grid.
        grid: The images' geometry.
        shape: ``(H, W)`` of the panorama.
        blend: ``nearest``: the owner's scores. ``feather``: the average of all images that cover a
            direction, weighted as in `tangent_to_equirect`; meant for probabilities.

    Returns:
        ``(..., H, W)`` class indices. The first of several equal scores wins, and NaN is ignored.
        An int64 tensor on the device of the logits, or an array, uint8 up to 256 classes and uint16
        above.

    Raises:
        SettingError: The logits, the shape or the blend cannot be used.
    """
    scores = _tensor(logits) if isinstance(logits, np.ndarray) else logits.detach()
    blend = blend_of(blend, is_overlapping=grid.is_overlapping)
    shape = check_shape(shape)
    check_images("scores", scores, grid)
    small = torch.uint8 if scores.shape[-3] <= 256 else torch.uint16
    stacks = scores.reshape(-1, *scores.shape[-4:])
    compiled = scores.device.type == "cpu" and scores.dtype != torch.float64
    flat = torch.zeros((len(stacks), *shape), dtype=small, device=scores.device)
    for stack, labels in zip(stacks, flat, strict=True):
        if compiled:
            owner = owners(grid, shape) if blend == "nearest" else NO_OWNERS
            label_canvas(stack.float().numpy(), PinholeViews(grid), owner, labels.numpy())
        else:
            _torch_labels(stack, grid, shape, blend, labels.view(-1))
    result = flat.reshape(*scores.shape[:-4], *shape)
    if isinstance(logits, np.ndarray):
        return result.numpy()
    return result.long()


def _tensor(array: NDArray[np.generic]) -> Tensor:
    """Return a tensor that shares the array's memory, or a copy if the array is read-only."""
    array = np.ascontiguousarray(array)
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def _from_arrays(
    images: NDArray[Any],
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend,
    interpolation: Interpolation,
) -> NDArray[Any]:
    """Run `tangent_to_equirect` on arrays ``(N, h, w[, C])``; integer results are rounded."""
    if interpolation == "nearest":
        pixels = images.reshape(-1, *images.shape[3:])
        bands = _bands(torch.device("cpu"), grid, shape, blend, np.dtype(np.float32))
        parts = (nearest_image_index(f[0], u[0], v[0], grid.size).numpy() for f, u, v, _ in bands)
        return np.concatenate([pixels[index] for index in parts]).reshape(*shape, *images.shape[3:])
    exact = (images.dtype.kind in "ui" and images.dtype.itemsize > 2) or images.dtype == np.float64
    stack = _tensor(images.astype(np.float64 if exact else np.float32, copy=False))
    stack = stack[:, None] if images.ndim == 3 else stack.movedim(-1, 1)
    if blend == "feather" and not exact:
        result = _feathered(stack.numpy(), grid, shape)
    else:
        result = tangent_to_equirect(stack, grid, shape, blend).movedim(0, -1).numpy()
    if images.dtype.kind in "ui":
        result = np.rint(result)
    return np.ascontiguousarray(result.reshape(*shape, *images.shape[3:]), images.dtype)


def _feathered(
    images: NDArray[np.float32], grid: PinholeGrid, shape: tuple[int, int]
) -> NDArray[np.float32]:
    """Feather ``(N, C, h, w)`` images to ``(H, W, C)``; a channel of ones sums the weights."""
    channels, step = images.shape[1], max(1, _BAND // shape[1])
    with_ones = np.ascontiguousarray(np.concatenate([images, np.ones_like(images[:, :1])], axis=1))
    panorama = np.empty((*shape, channels), np.float32)
    for start in range(0, shape[0], step):
        rows = slice(start, min(shape[0], start + step))
        sums = zero_sums((rows.stop - start, shape[1]), channels + 1)
        add_to_canvas(with_ones, PinholeViews(grid), shape, rows, NO_OWNERS, sums)
        total = sums[..., : channels + 1]
        panorama[rows] = total[..., :channels] / total[..., channels:]
    return panorama


def _bands(
    device: torch.device,
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend,
    dtype: np.dtype[np.floating],
) -> Iterator[tuple[Tensor, ...]]:
    """Yield a table for each band of rows: images, columns, rows and weights ``(R, pixels)``."""
    height, width = shape
    step = max(1, min(height, _BAND // width))
    for start in range(0, height, step):
        rows = slice(start, min(height, start + step))
        # Feathering needs large tables: if there are several bands, they are not cached.
        kept = blend == "nearest" or step == height
        key = (blend, shape, dtype, rows.start, rows.stop) if kept else None
        build = partial(image_table, grid, shape, dtype, blend, rows)
        table = tensors_on(device, grid, key, build)
        yield tuple(part.reshape(len(part), -1) for part in table)


def _torch_labels(
    scores: Tensor, grid: PinholeGrid, shape: tuple[int, int], blend: Blend, labels: Tensor
) -> None:
    """Write labels ``(H W,)`` of ``(N, K, h, w)`` scores of any device and dtype, by class."""
    num_classes, size = scores.shape[1], math.prod(grid.size)
    flat = scores.reshape(1, -1)
    dtype = map_dtype(scores.dtype == torch.float64, "bilinear")
    start = 0
    for face, u, v, weight in _bands(scores.device, grid, shape, blend, dtype):
        taps = image_taps(face, u, v, grid.size, weight, num_classes * size)
        label = taps.source.new_zeros((1, taps.source.shape[-1]))
        best = torch.full_like(label, -torch.inf, dtype=scores.dtype)
        for k in range(num_classes):
            score = sample(flat, Taps(taps.source + k * size, taps.weight))
            label.masked_fill_(score > best, k)
            best = torch.fmax(best, score)
        labels[start : start + label.shape[1]] = label[0].to(labels.dtype)
        start += label.shape[1]
