"""Argument checks of the renderers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import PinholeGrid

Blend = Literal["nearest", "feather"]
"""``nearest``: each pixel is taken from the image that owns it. ``feather``: the average of all
images that cover a pixel, with weights that fall to 0 at the borders of the images."""


def check_interpolation(interpolation: str, blend: str = "nearest") -> None:
    """Raise SettingError unless the interpolation exists and can be combined with the blend."""
    check_choice("interpolation", interpolation, ("bilinear", "nearest"))
    if interpolation == "nearest" and blend != "nearest":
        raise SettingError(
            "interpolation",
            found=f"'nearest' with blend {blend!r}",
            expected="blend='nearest'",
            remedy="Copied pixels cannot be averaged.",
        )


def blend_of(blend: Blend, *, is_overlapping: bool) -> Blend:
    """Return the blend, or ``nearest`` for images that do not overlap.

    Images without overlap meet at their edges, where feather weights are 0: the faces of a cube map
    without a margin, and the panorama itself.

    Args:
        blend: Requested blend.
        is_overlapping: True if every pixel is inside an image, not only on its outer edge.

    Raises:
        SettingError: There is no such blend.
    """
    check_choice("blend", blend, ("nearest", "feather"))
    return blend if is_overlapping else "nearest"


def check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise SettingError unless a value is one of those allowed."""
    if value not in allowed:
        raise SettingError(name, found=repr(value), expected=" or ".join(map(repr, allowed)))


def check_shape(shape: Sequence[int]) -> tuple[int, int]:
    """Return ``(H, W)`` as two integers; raise SettingError unless both are positive."""
    whole = [isinstance(side, int | np.integer) and side > 0 for side in shape]
    if len(whole) != 2 or not all(whole):
        raise SettingError("shape", found=tuple(shape), expected="(height, width), both 1 or more")
    return int(shape[0]), int(shape[1])


def check_panorama(image: Tensor | NDArray[np.generic], interpolation: str) -> None:
    """Raise SettingError unless a panorama, array or tensor, can be sampled."""
    check_interpolation(interpolation)
    array = isinstance(image, np.ndarray)
    fits = image.ndim in (2, 3) and 0 not in image.shape if array else image.ndim >= 3
    if not fits or 0 in image.shape[-2:]:
        expected = "(H, W) or (H, W, C)" if array else "(..., C, H, W)"
        raise SettingError("panorama", found=f"shape {tuple(image.shape)}", expected=expected)
    _check_numbers("panorama", image, interpolation)


def check_images(
    name: str,
    images: Tensor | NDArray[np.generic],
    grid: PinholeGrid,
    interpolation: str = "bilinear",
) -> None:
    """Raise SettingError unless there is an image of the right size for each face of a grid.

    Args:
        name: Name of the images in the message.
        images: Tensor ``(..., N, C, h, w)`` or array ``(N, h, w[, C])``.
        grid: Geometry of the images.
        interpolation: Interpolation that will be used to sample them.
    """
    shape, sides = tuple(images.shape), (grid.num_images, *grid.size)
    if isinstance(images, np.ndarray):
        fits, expected = len(shape) in (3, 4) and shape[:3] == sides, "({}, {}, {}[, channels])"
    else:
        fits = len(shape) >= 4 and (shape[-4], *shape[-2:]) == sides
        expected = "(..., {}, channels, {}, {})"
    if not fits:
        raise SettingError(
            name,
            found=f"shape {shape}",
            expected=f"{expected.format(*sides)} for this grid",
            remedy="All images of the grid are needed, in its order.",
        )
    _check_numbers(name, images, interpolation)


def _check_numbers(name: str, values: Tensor | NDArray[np.generic], interpolation: str) -> None:
    if isinstance(values, Tensor):
        usable = interpolation == "nearest" or torch.is_floating_point(values)
    else:
        usable = values.dtype.kind in ("uif" if interpolation == "bilinear" else "buif")
    if not usable:
        raise SettingError(
            name,
            found=f"dtype {values.dtype}",
            expected=f"numbers that {interpolation} interpolation can use",
            remedy="Convert them to floats, or use interpolation='nearest' for labels and masks.",
        )
