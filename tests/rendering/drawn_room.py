"""A room drawn by equations, independent of the code that is tested with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_LOW = np.array([-3.1, -2.2, -1.5])
_HIGH = np.array([2.4, 3.6, 1.2])
_GRAY = np.array([[150, 120], [170, 95], [80, 225]])  # of the lower and upper side of each axis


def draw_room(shape: tuple[int, int], rotation: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Draw a panorama inside a box: doors and pictures on its walls, tiles below, a bright ceiling.

    Args:
        shape: ``(H, W)``.
        rotation: ``(3, 3)``; up in the room is the direction ``rotation @ (0, 0, 1)``.

    Returns:
        ``(H, W, 3)`` uint8.
    """
    height, width = 2 * shape[0], 2 * shape[1]  # four rays per pixel
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    longitude = np.pi * ((np.arange(width) + 0.5) / width * 2 - 1)[None]
    x, y = np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude)
    rays = np.stack([x, y, np.sin(latitude) + 0 * longitude], axis=-1) @ rotation
    with np.errstate(divide="ignore"):
        distances = np.where(rays > 0, _HIGH, _LOW) / rays
    axis = distances.argmin(axis=-1)
    points = rays * distances.min(axis=-1)[..., None]
    upper = np.take_along_axis(rays, axis[..., None], axis=-1)[..., 0] > 0
    gray = _GRAY[axis, upper.astype(int)] + _decoration(points, axis, upper)
    pixels = gray.reshape(shape[0], 2, shape[1], 2).mean(axis=(1, 3))
    return np.repeat(np.rint(pixels).astype(np.uint8)[..., None], 3, axis=-1)


def _decoration(points: NDArray[Any], axis: NDArray[Any], upper: NDArray[Any]) -> NDArray[Any]:
    """Gray added to walls and floor at points in meters."""
    x, y, z = np.moveaxis(points, -1, 0)
    along = np.where(axis == 0, y, x)
    doors = (np.floor(along / 0.7) % 2 == 0) & (z < 0.55)
    pictures = (np.floor(along / 0.9) % 3 == 1) & (z > 0.1) & (z < 0.45)
    tiles = (np.floor(x / 0.6) + np.floor(y / 0.6)) % 2
    walls = np.where(doors, -45, 0) + np.where(pictures, 60, 0)
    return np.where(axis < 2, walls, np.where(upper, 0, 30 * tiles))
