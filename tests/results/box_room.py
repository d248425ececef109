"""A room of six walls, whose distances and views have closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]

LOWEST, HIGHEST = np.array([-2.2, -1.6, -1.5]), np.array([3.0, 1.9, 1.1])
"""Corners of the room in meters from the center: ahead, right, up."""


def exit_points(eye: Any, rays: Points) -> Points:
    """Where rays leave the room: the points on the sides of walls that face its inside.

    Args:
        eye: Start of the rays, inside or outside.
        rays: Directions ``(..., 3)``, of any length.

    Returns:
        ``(..., 3)``; NaN for rays that miss the room.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        both = (LOWEST - eye) / rays, (HIGHEST - eye) / rays
    enter = np.minimum(*both).max(axis=-1)
    leave = np.maximum(*both).min(axis=-1)
    leave = np.where((leave >= enter) & (leave > 0), leave, np.nan)
    points: Points = np.asarray(eye) + leave[..., None] * rays
    return points


def colors_at(points: Points) -> Points:
    """Colors that say where a point of the room is: 20 to 235, smooth along the walls."""
    colors: Points = 20 + 215 * (points - LOWEST) / (HIGHEST - LOWEST)
    return colors
