"""Depth in steps of 1/512 m, as in the files of Stanford2D3DS; 0 is missing."""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import ray_lengths
from tangent_train.rendering.resampling import resize

_Depth = TypeVar("_Depth", np.uint16, np.float32)

STEPS_PER_M = 512
"""Steps of depth per meter."""

MOST_STEPS = np.iinfo(np.uint16).max
"""Largest distance in 16 bits, about 128 m."""


def resize_depth(depth: NDArray[_Depth], shape: tuple[int, ...]) -> NDArray[_Depth]:
    """Downsample raw depth ``(H, W)``, 0 where missing, without mixing values.

    Like the nearest pixel, but where the center pixel is missing, the nearest valid pixel within
    the area of the target pixel is taken.
    """
    small = resize(depth, (shape[0], shape[1]), "nearest")
    holes = np.array(np.nonzero(small == 0))
    size = np.array([depth.shape]).T
    scale = size / np.array([shape]).T
    centers = (holes + 0.5) * scale
    # The first source pixel whose center lies in the area of the target pixel.
    first = np.ceil(holes * scale - 0.5).astype(np.intp)
    nearest = np.full(holes.shape[1], np.inf)
    for step in np.ndindex(math.ceil(scale[0, 0]), math.ceil(scale[1, 0])):
        pixel = np.minimum(first + np.array([step]).T, size - 1)
        away = np.abs(pixel + 0.5 - centers)
        distance, value = np.hypot(*away), depth[tuple(pixel)]
        better = (away <= scale / 2).all(axis=0) & (value > 0) & (distance < nearest)
        small[tuple(holes[:, better])] = value[better]
        nearest[better] = distance[better]
    return small


def meters_to_steps(depth_m: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Convert depth in meters to steps of 1/512 m, rounded, at most 65535 (128 m).

    Depth below half a step is rounded up to one step: 0 means missing.

    >>> meters_to_steps(np.array([0, 1e-4, 1, 1000], np.float32)).tolist()
    [0, 1, 512, 65535]
    """
    steps = np.minimum(depth_m * np.float32(STEPS_PER_M) + np.float32(0.5), MOST_STEPS)
    return np.maximum(steps.astype(np.uint16), depth_m > 0)


def distance_from_z_depth(
    z_depth: NDArray[np.uint16], camera_matrix: NDArray[np.float64]
) -> NDArray[np.uint16]:
    """Convert z-depth to the distance from the center of projection, as in panoramas.

    Args:
        z_depth: ``(H, W)`` depth along the optical axis in any unit, 0 where missing.
        camera_matrix: ``(3, 3)`` K for integer pixel centers.

    Returns:
        ``(H, W)`` in the same unit, rounded, at most 65535; 0 where missing.
    """
    lengths = ray_lengths(camera_matrix, z_depth.shape)
    return np.minimum(z_depth * lengths + 0.5, MOST_STEPS).astype(np.uint16)
