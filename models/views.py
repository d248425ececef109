"""Networks for single images on the views of whole shapes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Callable

    from torch import Tensor

__all__ = ["each_view"]

_DIMENSIONS = 5


def each_view(network: Callable[[Tensor], Tensor], images: Tensor) -> Tensor:
    """What a network makes of every view by itself.

    Args:
        network: Maps images ``(B, C, h, w)`` to anything with the same first dimension.
        images: ``(B, N, C, h, w)``, N views of each of B shapes.

    Returns:
        ``(B, N, …)``.

    Raises:
        SettingError: The images have another number of dimensions.
    """
    if images.ndim != _DIMENSIONS:
        raise SettingError(
            "images for a classifier of shapes",
            found=f"an array of shape {tuple(images.shape)}",
            expected="(shapes, views, channels, height, width)",
            remedy="It is a network for task=classification.",
        )
    found: Tensor = network(images.flatten(0, 1))
    return found.reshape(*images.shape[:2], *found.shape[1:])
