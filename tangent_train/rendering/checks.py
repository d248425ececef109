"""Checks of what callers hand to the renderers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import PinholeGrid

__all__ = [
    "check_blend",
    "check_images_array",
    "check_interpolation",
    "check_nearest",
    "check_numpy_image",
    "check_scores",
    "check_shape",
    "check_tangent_images",
    "check_torch_image",
]


def check_interpolation(interpolation: str) -> None:
    """Raise SettingError unless the interpolation is known."""
    _check_choice("interpolation", interpolation, ("bilinear", "nearest"))


def check_blend(blend: str, grid: PinholeGrid) -> None:
    """Raise SettingError unless the blend is known and the images can be blended so."""
    _check_choice("blend", blend, ("nearest", "feather"))
    if blend == "feather" and not grid.overlapping:
        raise SettingError(
            "blend",
            found="'feather'",
            expected="'nearest' for images that do not overlap",
            remedy="All weights are 0 on the edges where they meet.",
        )


def check_nearest(
    images: Tensor | NDArray[np.generic], grid: PinholeGrid, blend: str, interpolation: str
) -> None:
    """Raise SettingError unless images of any dtype can be taken to a panorama pixel by pixel."""
    check_interpolation(interpolation)
    if blend != "nearest":
        raise SettingError(
            "interpolation",
            found=f"'nearest' with blend {blend!r}",
            expected="blend='nearest'",
            remedy="What is taken pixel by pixel is not averaged.",
        )
    if isinstance(images, Tensor):
        _check_stack("tangent images", images, grid)
    else:
        check_images_array(images, grid)


def check_images_array(images: NDArray[np.generic], grid: PinholeGrid) -> None:
    """Raise SettingError unless an array is ``(N, d, d[, C])`` and fits the grid."""
    expected = (grid.num_images, grid.dim, grid.dim)
    if images.ndim not in (3, 4) or images.shape[:3] != expected:
        raise SettingError(
            "tangent images",
            found=f"shape {images.shape}",
            expected="({}, {}, {}[, channels]) for this grid".format(*expected),
            remedy="All images of the grid are needed, in its order.",
        )


def _check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise SettingError(name, found=repr(value), expected=" or ".join(map(repr, allowed)))


def check_shape(shape: Sequence[int]) -> tuple[int, int]:
    """``(H, W)`` as two positive integers, or SettingError."""
    whole = [isinstance(side, int | np.integer) and side > 0 for side in shape]
    if len(whole) != 2 or not all(whole):
        raise SettingError("shape", found=tuple(shape), expected="(height, width), both 1 or more")
    return int(shape[0]), int(shape[1])


def check_numpy_image(image: NDArray[np.generic], interpolation: str) -> None:
    """Raise SettingError unless NumPy code can sample a panorama ``(H, W[, C])``."""
    if image.ndim not in (2, 3) or 0 in image.shape:
        raise SettingError("panorama", found=f"shape {image.shape}", expected="(H, W) or (H, W, C)")
    kinds = "uif" if interpolation == "bilinear" else "buif"
    if image.dtype.kind not in kinds:
        raise SettingError(
            "panorama",
            found=f"dtype {image.dtype}",
            expected=f"numbers that {interpolation} interpolation can use",
            remedy="Convert it, or use interpolation='nearest' for labels and masks.",
        )


def check_torch_image(image: Tensor, interpolation: str) -> None:
    """Raise SettingError unless torch code can sample a panorama ``(..., C, H, W)``."""
    if image.ndim < 3 or 0 in image.shape[-2:]:
        found = f"shape {tuple(image.shape)}"
        raise SettingError("panorama", found=found, expected="(..., C, H, W)")
    if interpolation == "bilinear":
        _check_floating("panorama", image)


def _check_floating(name: str, tensor: Tensor) -> None:
    if not torch.is_floating_point(tensor):
        raise SettingError(
            name,
            found=f"dtype {tensor.dtype}",
            expected="a floating-point dtype",
            remedy="Call .float() first.",
        )


def check_tangent_images(images: Tensor, grid: PinholeGrid) -> None:
    """Raise SettingError unless images are ``(..., N, C, d, d)`` floats that fit the grid."""
    _check_stack("tangent images", images, grid)
    _check_floating("tangent images", images)


def check_scores(scores: Tensor, grid: PinholeGrid) -> None:
    """Raise SettingError unless scores are ``(..., N, K, d, d)`` floats that fit the grid."""
    _check_stack("scores", scores, grid)
    _check_floating("scores", scores)
    if scores.shape[-3] == 0:
        raise SettingError("scores", found="no class", expected="one class or more")


def _check_stack(name: str, images: Tensor, grid: PinholeGrid) -> None:
    shape = tuple(images.shape)
    expected = (grid.num_images, grid.dim, grid.dim)
    if len(shape) < 4 or (shape[-4], *shape[-2:]) != expected:
        raise SettingError(
            name,
            found=f"shape {shape}",
            expected="(..., {}, channels, {}, {}) for this grid".format(*expected),
            remedy="All images of the grid are needed, in its order.",
        )
