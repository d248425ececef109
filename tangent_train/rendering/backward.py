"""Render tangent images back to the panorama."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.geometry import PinholeGrid
from tangent_train.rendering.checks import (
    Blend,
    blend_of,
    check_images,
    check_interpolation,
    check_shape,
)
from tangent_train.rendering.forward import Interpolation, Pixels
from tangent_train.rendering.mosaic import Backend, MeanMosaic, Mosaic
from tangent_train.rendering.representations.views import PinholeViews
from tangent_train.rendering.tables import nearest_pixels


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
    if interpolation == "nearest":
        index = nearest_pixels(grid, shape)
        if isinstance(images, np.ndarray):
            return images.reshape(-1, *images.shape[3:])[index]
        pixels = images.movedim(-4, -3).flatten(-3)
        return pixels[..., torch.from_numpy(index).to(images.device)]
    if isinstance(images, np.ndarray):
        return _from_arrays(images, grid, shape, blend)
    flat = images.reshape(-1, *images.shape[-4:]).movedim(0, 1).flatten(1, 2)
    result = _means(flat, grid, shape, blend).to(images.dtype)
    return result.reshape(*images.shape[:-4], images.shape[-3], *shape)


def tangent_to_labels(
    logits: Pixels, grid: PinholeGrid, shape: tuple[int, int], blend: Blend = "nearest"
) -> Pixels:
    """Return the class of the largest bilinear score at every pixel of the panorama.

    Rendering and argmax are one step, so the scores of the panorama, ``(K, H, W)``, are not held in
    memory, except on a GPU with the blend ``feather``. All scores are rendered in float32.

    Args:
        logits: ``(..., N, K, h, w)`` floating-point scores of all images of the grid.
        grid: The images' geometry.
        shape: ``(H, W)`` of the panorama.
        blend: ``nearest``: the owner's scores. ``feather``: the average of all images that cover a
            direction, weighted as in `tangent_to_equirect`; meant for probabilities.

    Returns:
        ``(..., H, W)`` class indices. The first of several equal scores wins, and NaN is ignored.
        An int64 tensor on the device of the logits, or an array, uint8 below 256 classes and else
        uint16.

    Raises:
        SettingError: The logits, the shape or the blend cannot be used.
    """
    scores = _tensor(logits) if isinstance(logits, np.ndarray) else logits.detach()
    blend = blend_of(blend, is_overlapping=grid.is_overlapping)
    shape = check_shape(shape)
    check_images("scores", scores, grid)
    is_summed = blend == "feather" and scores.device.type != "cpu"
    labels: list[Tensor] = []
    for stack in scores.reshape(-1, *scores.shape[-4:]):
        mosaic = Mosaic(
            shape,
            stack.shape[1],
            blend,
            averaged=is_summed,
            device=scores.device,
            backend="numba" if scores.device.type == "cpu" else "torch",
        )
        mosaic.add(stack, PinholeViews(grid))
        labels.append(mosaic.labels())
    if isinstance(logits, np.ndarray):
        return torch.stack(labels).reshape(*scores.shape[:-4], *shape).numpy()
    empty = torch.zeros((0, *shape), dtype=torch.int64, device=scores.device)
    found = torch.cat([empty, *(part.long()[None] for part in labels)])
    return found.reshape(*scores.shape[:-4], *shape)


def _tensor(array: NDArray[np.generic]) -> Tensor:
    """Return a tensor that shares the array's memory, or a copy if the array is read-only."""
    array = np.ascontiguousarray(array)
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def _means(images: Tensor, grid: PinholeGrid, shape: tuple[int, int], blend: Blend) -> Tensor:
    """Return the means ``(C, H, W)`` of images ``(N, C, h, w)``, differentiably."""
    is_exact = images.dtype == torch.float64
    is_simple = images.device.type == "cpu" and not (images.requires_grad or is_exact)
    backend: Backend = "numba" if is_simple else "torch"
    mosaic = MeanMosaic(
        shape,
        blend,
        images.shape[1],
        skips_unknown=False,
        device=images.device,
        backend=backend,
        dtype=torch.float64 if is_exact else torch.float32,
    )
    mosaic.add(images, PinholeViews(grid))
    return mosaic.values()


def _from_arrays(
    images: NDArray[Any], grid: PinholeGrid, shape: tuple[int, int], blend: Blend
) -> NDArray[Any]:
    """Run `tangent_to_equirect` on arrays ``(N, h, w[, C])``; integer results are rounded."""
    is_exact = images.dtype == np.float64 or images.dtype in (np.int32, np.uint32, np.int64)
    stack = _tensor(images.astype(np.float64 if is_exact else np.float32, copy=False))
    stack = stack[:, None] if images.ndim == 3 else stack.movedim(-1, 1)
    result = _means(stack, grid, shape, blend).movedim(0, -1).numpy()
    if images.dtype.kind in "ui":
        result = np.rint(result)
    return np.ascontiguousarray(result.reshape(*shape, *images.shape[3:]), images.dtype)
