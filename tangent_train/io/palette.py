"""Colors of classes and of distances."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

_STEPS = 12  # values of each channel to choose from
_LIGHTNESS = (35, 90)  # L*: black is the unknown class, white the page
_SEEN = np.array(
    [
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        # Without L and without M cones: Machado, Oliveira, Fernandes 2009, severity 1.
        [[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]],
        [[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]],
    ]
)
"""Linear RGB as seen with full color vision, and without red or green cones."""


@lru_cache
def class_colors(num_classes: int) -> NDArray[np.uint8]:
    """Return distinct colors, black for the unknown class 0.

    Each is the one that is farthest from all before it in CIELAB: by full color vision plus three
    times by the worse of eyes without red and without green cones. Classes with small numbers,
    often neighbors, differ most.

    Args:
        num_classes: K + 1, to 256.

    Returns:
        ``(K+1, 3)`` RGB, not writable.
    """
    values = np.linspace(0, 1, _STEPS)
    srgb = np.stack(np.meshgrid(values, values, values, indexing="ij"), axis=-1).reshape(-1, 3)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ _SEEN.transpose(0, 2, 1), 0, 1).astype(np.float32)
    lab = np.stack([cv2.cvtColor(image[None], cv2.COLOR_LRGB2Lab)[0] for image in seen], axis=1)
    light = lab[:, 0, 0]
    away = np.where((light >= _LIGHTNESS[0]) & (light <= _LIGHTNESS[1]), np.inf, 0.0)
    chosen = [0]  # black
    while len(chosen) < num_classes:
        distances = np.linalg.norm(lab - lab[chosen[-1]], axis=-1)
        away = np.minimum(away, distances[:, 0] + 3 * distances[:, 1:].min(axis=1))
        chosen.append(int(away.argmax()))
    colors = (srgb[chosen[:num_classes]] * 255).round().astype(np.uint8)
    colors.setflags(write=False)
    return colors


@lru_cache
def distance_colors() -> NDArray[np.uint8]:
    """Return 256 RGB colors from the nearest to the farthest distance, not writable.

    They are viridis from its bright end: equal steps look equally large, and near is brighter than
    far without color vision too.
    """
    ramp = np.arange(255, -1, -1, dtype=np.uint8)[:, None]
    colors: NDArray[np.uint8] = np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_VIRIDIS), np.uint8)
    colors = np.ascontiguousarray(colors[:, 0, ::-1])
    colors.setflags(write=False)
    return colors
