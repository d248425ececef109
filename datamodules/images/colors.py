"""Colour augmentation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchvision.transforms.v2 import functional

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

__all__ = ["jitter_colors"]

_HUE_SHARE = 0.1


def jitter_colors(rgb: Tensor, strength: float, rng: np.random.Generator) -> Tensor:
    """Change brightness, contrast, saturation and, a little, hue of all images alike.

    Args:
        rgb: ``(n, h, w, 3)`` uint8, views of one panorama or photo.
        strength: 0 to 1. The factors of the first three are uniform in 1 ± strength, hue is
            rotated by up to strength / 10 of the circle either way.
        rng: Generator of four numbers.

    Returns:
        ``(n, h, w, 3)`` uint8.
    """
    brightness, contrast, saturation = rng.uniform(1 - strength, 1 + strength, 3)
    hue = rng.uniform(-1, 1) * strength * _HUE_SHARE
    # One high image: contrast is about the mean of all, or neighbours would part at their seams.
    image = rgb.flatten(0, 1).movedim(-1, 0)
    image = functional.adjust_brightness(image, brightness)
    image = functional.adjust_contrast(image, contrast)
    image = functional.adjust_saturation(image, saturation)
    image = functional.adjust_hue(image, hue)
    return image.movedim(0, -1).reshape(rgb.shape)
