"""Colours of classes."""

from __future__ import annotations

import colorsys
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["class_colors"]


def class_colors(num_classes: int) -> NDArray[np.uint8]:
    """Distinct colours, black for the unknown class 0.

    Args:
        num_classes: K + 1.

    Returns:
        ``(K+1, 3)`` RGB: hues a golden ratio apart, in three brightnesses.
    """
    colors = [
        colorsys.hsv_to_rgb(k * 0.618034 % 1, 0.45 + 0.4 * (k % 2), 0.95 - 0.15 * (k % 3))
        for k in range(1, num_classes)
    ]
    return (np.array([(0, 0, 0), *colors]) * 255).round().astype(np.uint8)
