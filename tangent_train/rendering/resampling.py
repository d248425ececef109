"""Resize whole panoramas, and crops of photos.

Arrays are resized by OpenCV and Pillow, on the CPU. Tensors are resized on their device with the
same filters, first the rows and then the columns.
"""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    from torch import Tensor
    from typing_extensions import TypeIs

Interpolation = Literal["bilinear", "nearest"]

Pixels = TypeVar("Pixels", "Tensor", NDArray[Any])
"""A tensor or an array; results are of the same kind."""

Box = NDArray[np.float64]
"""Left, top, right and bottom of a part of an image, in pixels from its corner."""

_RESIZABLE = (np.uint8, np.uint16, np.float32, np.float64)
"""Types that OpenCV resizes without loss."""

_KEPT_PIXELS = 1.5
"""Pixels of a reduced panorama along the side of a pixel of a view: bilinear interpolation lowers
the variance of noise as much as the mean of 1.5 × 1.5 pixels."""

_MOST_PIXELS = 1.6
"""Most pixels of a panorama that is not reduced. At the level of the views there are 1.3 to 1.5."""


def is_tensor(image: object) -> TypeIs[Tensor]:
    """Return True for a tensor; torch, which takes seconds to import, is not imported for it."""
    return "torch" in sys.modules and isinstance(image, sys.modules["torch"].Tensor)


def resize(image: Pixels, shape: tuple[int, int], interpolation: Interpolation) -> Pixels:
    """Resize a whole image.

    Args:
        image: An array ``(H, W[, C])``, or a tensor ``(..., C, H, W)``.
        shape: Rows and columns of the result.
        interpolation: ``bilinear``, which averages areas along the sides that become smaller;
            ``nearest`` takes the pixel at the center of each pixel of the result.
    """
    height, width = image.shape[-2:] if is_tensor(image) else image.shape[:2]
    if (height, width) == shape:
        return image
    if interpolation == "nearest":
        rows, columns = (
            (2 * np.arange(after) + 1) * before // (2 * after)
            for after, before in zip(shape, (height, width), strict=True)
        )
        return _pick(image, rows, columns)
    if is_tensor(image):
        return _filtered(image, np.array((0.0, 0.0, width, height)), shape, "area")
    exact = image if image.dtype in _RESIZABLE else image.astype(np.float64)
    whole = [exact]
    if exact.shape[2:] > (4,):  # OpenCV averages areas of four channels at most
        whole = list(np.moveaxis(exact, -1, 0))
    resized = np.stack([_resized(part, shape) for part in whole], axis=-1)
    resized = resized.reshape(*shape, *image.shape[2:])
    if exact is not image and image.dtype.kind in "ui":
        resized = np.rint(resized)
    result: Any = resized.astype(image.dtype, copy=False)
    return result


def _resized(image: NDArray[Any], shape: tuple[int, int]) -> NDArray[Any]:
    """Resize ``(H, W[, C])``: OpenCV averages areas only if both sides become smaller."""
    rows, columns = (min(sides) for sides in zip(shape, image.shape, strict=False))
    resized: Any = np.ascontiguousarray(image)
    if (rows, columns) != image.shape[:2]:
        resized = cv2.resize(resized, (columns, rows), interpolation=cv2.INTER_AREA)
    if (rows, columns) != shape:
        resized = cv2.resize(resized, shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(resized)


def reduce_to_pitch(image: Pixels, pitch: float) -> Pixels:
    """Reduce a panorama to the resolution of pinhole images, so that they have no aliasing.

    Args:
        image: An array ``(H, W[, C])``, or a tensor ``(..., C, H, W)``, of colors or other values
            that can be averaged.
        pitch: Distance of neighboring pixels of the images, in focal lengths.

    Returns:
        A panorama of which a pixel in the middle of an image covers 1.5 × 1.5 pixels, averaged over
        areas; the panorama itself if it has about as few pixels.
    """
    sides = image.shape[-2:] if is_tensor(image) else image.shape[:2]
    covered = [pitch * side / angle for side, angle in zip(sides, (math.pi, math.tau), strict=True)]
    rows, columns = (
        side if pixels <= _MOST_PIXELS else math.ceil(side * _KEPT_PIXELS / pixels)
        for side, pixels in zip(sides, covered, strict=True)
    )
    return resize(image, (rows, columns), "bilinear")


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
    if is_tensor(image):
        return _filtered(image, box, shape, "triangle")
    corners = tuple(box.tolist())
    resized = Image.fromarray(image).resize(shape[::-1], Image.Resampling.BILINEAR, box=corners)
    result: Any = np.asarray(resized)
    return result


def _pick(image: Pixels, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Pixels:
    if not is_tensor(image):
        return image[rows][:, columns]
    from tangent_train.rendering.tensors import on_device

    down, across = (on_device(index, image.device) for index in (rows, columns))
    return image.index_select(-2, down).index_select(-1, across)


def _filtered(
    image: Tensor, box: Box, shape: tuple[int, int], kind: Literal["area", "triangle"]
) -> Tensor:
    """Resize a part of ``(..., H, W)``."""
    from tangent_train.rendering.tensors import exact, weigh_rows

    result = exact(image)
    for axis, (near, far) in ((0, box[1::2]), (1, box[::2])):
        before, after = result.shape[-2], shape[axis]
        if (before, near, far) != (after, 0, after):
            result = weigh_rows(result, *_taps(before, near, far, after, kind))
        result = result.mT
    return result.to(image.dtype)


def _taps(
    before: int, near: float, far: float, after: int, kind: Literal["area", "triangle"]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the first pixel ``(after,)`` of each result, and the weights ``(taps, after)``."""
    scale = (far - near) / after
    wide, centers = max(scale, 1.0), near + (np.arange(after) + 0.5) * scale
    if kind == "area":  # interpolates where the result has more pixels
        centers = centers.clip(0.5, before - 0.5)
    half = (wide + 1) / 2 if kind == "area" else wide
    first = np.ceil(centers - half - 0.5).astype(np.int64)
    pixels = first + np.arange(math.ceil(2 * half) + 1)[:, None]
    away = np.abs(pixels + 0.5 - centers)
    weights = np.minimum(half - away, 1) if kind == "area" else 1 - away / wide
    weights = np.where((pixels >= 0) & (pixels < before), weights, 0).clip(0)
    return first, weights / weights.sum(axis=0)
