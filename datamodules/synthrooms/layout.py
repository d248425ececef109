"""Floor plans: rectangles and L-shapes, their walls, and free space.

Room coordinates are right-handed, in meters, z up; the floor is z = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

Zone = Literal["low", "high", "full"]
"""Part of a wall's height that an item occupies: up to about a meter, above, or all of it."""

_TRIES = 24
_GAP = 0.06


class NoPlaceError(Exception):
    """An item does not fit into a room, and is left out."""


class Frame(NamedTuple):
    """A coordinate frame: an origin in the room and a rotation about the vertical.

    Attributes:
        x: Origin in meters.
        y: Origin in meters.
        z: Origin in meters.
        yaw: Counterclockwise rotation seen from above, in radians.
    """

    x: float
    y: float
    z: float = 0.0
    yaw: float = 0.0

    def at(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Frame:
        """Return the frame at (x, y, z) of this frame, rotated by a further `yaw`."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return Frame(
            self.x + cos * x - sin * y, self.y + sin * x + cos * y, self.z + z, self.yaw + yaw
        )


class Rectangle(NamedTuple):
    """Axis-aligned rectangle on the floor, given by its least and greatest x and y."""

    x0: float
    y0: float
    x1: float
    y1: float

    def meets(self, other: Rectangle, gap: float = 0.0) -> bool:
        """Return True if two rectangles are closer than `gap` meters along both axes."""
        in_x = self.x0 < other.x1 + gap and other.x0 < self.x1 + gap
        return in_x and self.y0 < other.y1 + gap and other.y0 < self.y1 + gap

    @classmethod
    def around(cls, frame: Frame, x: tuple[float, float], y: tuple[float, float]) -> Rectangle:
        """Return the smallest rectangle around ``x[0] … x[1]`` by ``y[0] … y[1]`` in `frame`."""
        corners = [frame.at(a, b) for a in x for b in y]
        xs, ys = [c.x for c in corners], [c.y for c in corners]
        return cls(min(xs), min(ys), max(xs), max(ys))


@dataclass
class Wall:
    """One straight wall.

    Attributes:
        frame: At the wall's start; x runs along it, y into the room.
        length: In meters.
        taken: Occupied stretches: start and end along the wall, and zone.
    """

    frame: Frame
    length: float
    taken: list[tuple[float, float, Zone]] = field(default_factory=list)

    def is_free(self, start: float, end: float, zone: Zone) -> bool:
        """Return True if the wall is free between two positions along it."""
        return not any(
            start < b + _GAP and a < end + _GAP and (zone == other or "full" in (zone, other))
            for a, b, other in self.taken
        )


class FloorPlan:
    """Rectangle, or L-shape: a rectangle without its corner of greatest x and y.

    Args:
        size: Width (x), depth (y) and height (z) of the room in meters.
        notch: Width and depth of the missing corner; None for a plain rectangle.
    """

    def __init__(
        self, size: tuple[float, float, float], notch: tuple[float, float] | None = None
    ) -> None:
        self.width, self.depth, self.height = size
        self._taken: list[Rectangle] = []
        x, y = self.width, self.depth
        self.notch: Rectangle | None = None
        corners = [(0.0, 0.0), (x, 0.0), (x, y), (0.0, y)]
        if notch is not None:
            a, b = x - notch[0], y - notch[1]
            self.notch = Rectangle(a, b, x, y)
            corners[2:3] = [(x, b), (a, b), (a, y)]
        self.walls = []
        for (x0, y0), (x1, y1) in pairwise([*corners, corners[0]]):
            frame = Frame(x0, y0, yaw=math.atan2(y1 - y0, x1 - x0))
            self.walls.append(Wall(frame, math.hypot(x1 - x0, y1 - y0)))

    @property
    def floors(self) -> list[Rectangle]:
        """One or two rectangles that together make the floor."""
        if self.notch is None:
            return [Rectangle(0, 0, self.width, self.depth)]
        return [
            Rectangle(0, 0, self.width, self.notch.y0),
            Rectangle(0, self.notch.y0, self.notch.x0, self.depth),
        ]

    @property
    def floor_area(self) -> float:
        """Area of the floor in square meters."""
        return sum((r.x1 - r.x0) * (r.y1 - r.y0) for r in self.floors)

    def contains(self, area: Rectangle, margin: float = 0.0) -> bool:
        """Return True if a rectangle is inside and `margin` meters away from every wall."""
        in_x = area.x0 >= margin and area.x1 <= self.width - margin
        inside = in_x and area.y0 >= margin and area.y1 <= self.depth - margin
        return inside and not (self.notch is not None and area.meets(self.notch, margin))

    def claim(self, area: Rectangle, margin: float = 0.0, gap: float = 0.0) -> bool:
        """Occupy a rectangle of the floor if it is inside and free; return True if so.

        Args:
            area: Rectangle to occupy.
            margin: Distance from every wall in meters.
            gap: Distance from everything else in meters.
        """
        is_free = not any(area.meets(other, gap) for other in self._taken)
        if is_free and self.contains(area, margin):
            self._taken.append(area)
            return True
        return False

    def against_wall(
        self, rng: np.random.Generator, width: float, depth: float, zone: Zone
    ) -> Frame:
        """Find and occupy a place at a wall.

        Args:
            rng: Source of randomness.
            width: Meters along the wall.
            depth: Meters of floor in front of it to occupy; 0 for hanging items.
            zone: Part of the wall's height.

        Returns:
            Frame at the middle of the stretch on the floor, x along the wall, y into the room.

        Raises:
            NoPlaceError: No place was found.
        """
        lengths = np.array([wall.length for wall in self.walls])
        for _ in range(_TRIES):
            wall = self.walls[rng.choice(len(lengths), p=lengths / lengths.sum())]
            room = wall.length - width - 0.24
            middle = width / 2 + 0.12 + rng.random() * max(room, 0)
            start, end = middle - width / 2, middle + width / 2
            frame = wall.frame.at(middle, 0)
            area = Rectangle.around(frame, (-width / 2, width / 2), (0.005, max(depth, 0.01)))
            fits = self.claim if depth else self.contains
            if room > 0 and wall.is_free(start, end, zone) and fits(area):
                wall.taken.append((start, end, zone))
                return frame
        raise NoPlaceError

    def in_the_open(
        self, rng: np.random.Generator, width: float, depth: float, gap: float = 0.12
    ) -> Frame:
        """Find and occupy an axis-aligned place of ``width × depth`` meters away from the walls.

        Raises:
            NoPlaceError: No place was found.
        """
        for _ in range(_TRIES):
            frame = Frame(rng.uniform(0, self.width), rng.uniform(0, self.depth))
            area = Rectangle.around(frame, (-width / 2, width / 2), (-depth / 2, depth / 2))
            if self.claim(area, 0.1, gap):
                return frame
        raise NoPlaceError
