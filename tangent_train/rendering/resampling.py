"""Resize whole panoramas, and crops of photos.

Arrays are resized by OpenCV and Pillow, on the CPU. Tensors are resized on their device with the
same filters, by products with one matrix of weights for the rows and one for the columns.
"""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from tangent_train.rendering.forward import Interpolation, Pixels

Box = NDArray[np.float64]
"""Left, top, right and bottom of a part of an image, in pixels from its corner."""


def resize(image: Pixels, shape: tuple[int, int], interpolation: Interpolation) -> Pixels:
    """Resize a whole image.

    Args:
        image: An array ``(H, W[, C])``, or a tensor ``(C, H, W)``.
        shape: Rows and columns of the result.
        interpolation: ``bilinear``, which averages areas if the image becomes smaller; ``nearest``
            takes the pixel at the center of each pixel of the result.
    """
    height, width = image.shape[-2:] if isinstance(image, Tensor) else image.shape[:2]
    if (height, width) == shape:
        return image
    if interpolation == "nearest":
        rows, columns = (
            (2 * np.arange(after) + 1) * before // (2 * after)
            for after, before in zip(shape, (height, width), strict=True)
        )
        return _pick(image, rows, columns)
    smaller = shape[0] < height
    if isinstance(image, Tensor):
        whole = np.array((0.0, 0.0, width, height))
        return _filtered(image, whole, shape, "area" if smaller else "linear")
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    resized: Any = cv2.resize(image, shape[::-1], interpolation=method)
    return resized


def crop(image: Pixels, box: Box, shape: tuple[int, int], interpolation: Interpolation) -> Pixels:
    """Cut out a part of an image and resize it.

    Args:
        image: An array ``(H, W[, C])``, uint8 for ``bilinear``; or a tensor ``(C, H, W)``.
        box: Position of the part.
        shape: Rows and columns of the result.
        interpolation: ``bilinear``, with antialiasing if the part becomes smaller: a triangle
            filter two pixels of the result wide. ``nearest`` takes the pixel at the center of each
            pixel of the result.
    """
    if interpolation == "nearest":
        columns, rows = (
            np.linspace(near, far, 2 * count + 1)[1::2].astype(np.intp)
            for near, far, count in zip(box[:2], box[2:], shape[::-1], strict=True)
        )
        return _pick(image, rows, columns)
    if isinstance(image, Tensor):
        return _filtered(image, box, shape, "triangle")
    corners = tuple(box.tolist())
    resized = Image.fromarray(image).resize(shape[::-1], Image.Resampling.BILINEAR, box=corners)
    result: Any = np.asarray(resized)
    return result


def _pick(image: Pixels, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Pixels:
    if isinstance(image, np.ndarray):
        return image[rows][:, columns]
    down, across = (torch.from_numpy(index).to(image.device) for index in (rows, columns))
    return image.index_select(-2, down).index_select(-1, across)


def _filtered(
    image: Tensor,
    box: Box,
    shape: tuple[int, int],
    kind: Literal["area", "linear", "triangle"],
) -> Tensor:
    """Resize a part of ``(C, H, W)``."""
    down, across = (
        torch.from_numpy(_weights(image.shape[axis - 2], near, far, count, kind)).to(image.device)
        for axis, (near, far, count) in enumerate(
            ((box[1], box[3], shape[0]), (box[0], box[2], shape[1]))
        )
    )
    with torch.autocast(image.device.type, enabled=False):
        return down @ (image @ across.T)


def _weights(
    before: int, near: float, far: float, after: int, kind: Literal["area", "linear", "triangle"]
) -> NDArray[np.float32]:
    """Return ``(after, before)`` weights that resample an axis from `near` to `far`."""
    scale = (far - near) / after
    centers = near + (np.arange(after)[:, None] + 0.5) * scale
    pixels = np.arange(before) + 0.5
    if kind == "area":
        weights = np.minimum(centers + scale / 2, pixels + 0.5) - np.maximum(
            centers - scale / 2, pixels - 0.5
        )
    else:
        wide = max(scale, 1.0)
        centers = centers.clip(0.5, before - 0.5) if kind == "linear" else centers
        weights = 1 - np.abs(pixels - centers) / wide
    weights = weights.clip(0)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
