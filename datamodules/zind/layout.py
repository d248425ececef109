"""Classes and distances of a room layout from a camera, in closed form.

Walls stand upright on a polygon around the camera, floor and ceiling are level, and doors, windows
and openings are rectangles on the walls. A column of a panorama is a vertical plane: it shows the
nearest wall in its direction, and the height at which a row meets that wall decides between floor,
wall and ceiling. The only approximation is that pixels are sampled at their centers.

The frame is ZInD's, as overlays on the pictures show: x to the left, y to the middle column, z up,
the camera in the origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_latitudes, equirect_longitudes

CLASSES: tuple[str, ...] = ("ceiling", "floor", "wall", "door", "window")
"""The classes as labels 1 to 5; 0 is unknown."""

_CEILING, _FLOOR, _WALL, DOOR, WINDOW = range(1, 6)
OPENING = 0
"""Openings are unknown: they show the next room, which the layout does not describe."""

_OFF_WALL = 0.05
"""Largest distance of a fixture from its wall, in camera heights (sample tour: 0.002)."""

_OFF_DIRECTION = 0.2
"""Largest sine of the angle between a fixture and its wall; separates the walls of a corner."""

_ROUNDING = 1e-9
"""Share by which walls are extended, so that a ray to a corner hits one of them."""


class Fixture(NamedTuple):
    """A door, window or opening: an upright rectangle on a wall.

    Attributes:
        ends: ``(2, 2)`` x and y of its ends, in any order.
        bottom_z: Height of its lower edge.
        top_z: Height of its upper edge.
        label: `DOOR`, `WINDOW` or `OPENING`.
    """

    ends: NDArray[np.float64]
    bottom_z: float
    top_z: float
    label: int


@dataclass(frozen=True, eq=False)
class Layout:
    """A room around a camera, in camera heights.

    Attributes:
        vertices: ``(n, 2)`` x and y of its corners, in order; the polygon contains the camera.
        floor_z: Height of the floor, below 0.
        ceiling_z: Height of the ceiling, above 0.
        fixtures: Fixtures on the walls; where several overlap, the first one is used.
    """

    vertices: NDArray[np.float64]
    floor_z: float
    ceiling_z: float
    fixtures: Sequence[Fixture] = ()

    def labels(self, shape: tuple[int, int]) -> NDArray[np.uint8]:
        """Return the class of every pixel of a panorama of a shape ``(H, W)``."""
        away, points, along = self._columns(shape[1])
        z = np.tan(equirect_latitudes(shape[0]))[:, None] * away
        labels = np.full(shape, _WALL, np.uint8)
        labels[z < self.floor_z] = _FLOOR
        labels[z > self.ceiling_z] = _CEILING
        for fixture in self.fixtures:
            on = np.nonzero(_on(fixture, points, along))[0]
            inside = (z[:, on] >= fixture.bottom_z) & (z[:, on] <= fixture.top_z)
            before = labels[:, on]
            labels[:, on] = np.where(inside & (before == _WALL), np.uint8(fixture.label), before)
        return labels

    def distances(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Return the distance from the camera for every pixel of a panorama of a shape ``(H, W)``.

        It is NaN on doors, windows and openings, which may show what is behind them.
        """
        latitudes = equirect_latitudes(shape[0])[:, None]
        with np.errstate(divide="ignore"):  # on the horizon, which never reaches floor or ceiling
            plane = np.where(latitudes < 0, self.floor_z, self.ceiling_z) / np.tan(latitudes)
        distances = np.minimum(np.abs(plane), self._columns(shape[1])[0]) / np.cos(latitudes)
        known = np.isin(self.labels(shape), (_CEILING, _FLOOR, _WALL))
        return np.where(known, distances, np.nan)

    def _columns(self, width: int) -> tuple[NDArray[np.float64], ...]:
        """Return horizontal distance, x and y, and direction of the wall in each column."""
        longitudes = equirect_longitudes(width)
        ahead = np.stack([-np.sin(longitudes), np.cos(longitudes)], axis=-1)
        walls = np.roll(self.vertices, -1, axis=0) - self.vertices
        with np.errstate(divide="ignore", invalid="ignore"):  # walls seen from their end
            facing = _cross(ahead[:, None], walls)
            away = _cross(self.vertices, walls) / facing
            place = _cross(self.vertices, ahead[:, None]) / facing
        met = (away > 0) & (np.abs(place - 0.5) <= 0.5 + _ROUNDING)
        nearest = np.where(met, away, np.inf).argmin(axis=1)
        away = away[np.arange(width), nearest]
        along = walls / np.maximum(np.linalg.norm(walls, axis=-1, keepdims=True), 1e-300)
        return away, ahead * away[:, None], along[nearest]


def _on(
    fixture: Fixture, points: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return the columns, at points of walls, that show a fixture's part of a wall."""
    start, end = fixture.ends
    length = np.linalg.norm(end - start)
    direction = (end - start) / length
    place = (points - start) @ direction
    off = np.abs(_cross(points - start, direction))
    askew = np.abs(_cross(along, direction))
    return (place >= 0) & (place <= length) & (off <= _OFF_WALL) & (askew <= _OFF_DIRECTION)


def _cross(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
