"""Rooms under construction: floor plan, free space, and items composed of boxes and cylinders.

Room coordinates are right-handed, in meters, z up; the floor is z = 0.

``tables/synthrooms_parts.csv`` is the table of parts of all furniture. A position or size in it
is a sum such as ``0.5wide-0.03``, in meters and in values of the piece. `mirror` repeats rows at
−x (``x``), or at −x and −y (``xy``). ``body:0.6`` is the material `body`, shaded by 0.6.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import groupby, pairwise
from operator import itemgetter
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from trimesh import creation

from datamodules.synthrooms.materials import Limits, Material, Palette
from datamodules.tables import read_table

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
    def around(cls, frame: Frame, x: Limits, y: Limits) -> Rectangle:
        """Return the smallest rectangle around ``x[0] … x[1]`` by ``y[0] … y[1]`` in `frame`."""
        xs, ys, *_ = zip(*(frame.at(a, b) for a in x for b in y), strict=True)
        return cls(min(xs), min(ys), max(xs), max(ys))


class Wall(NamedTuple):
    """One straight wall.

    Attributes:
        frame: At the wall's start; x runs along it, y into the room.
        length: In meters.
        taken: Occupied stretches: start and end along the wall, and zone.
    """

    frame: Frame
    length: float
    taken: list[tuple[float, float, Zone]]


class FloorPlan:
    """Rectangle, or L-shape: a rectangle without its corner of greatest x and y.

    Args:
        size: Width (x), depth (y) and height (z) of the room in meters.
        notch: Width and depth of the missing corner; None for a plain rectangle.

    Attributes:
        walls: Straight walls, counterclockwise.
        floors: One or two rectangles that together make the floor.
        notch: Missing corner.
    """

    def __init__(self, size: tuple[float, float, float], notch: Limits | None = None) -> None:
        self.width, self.depth, self.height = x, y, _ = size
        self._taken: list[Rectangle] = []
        self.notch: Rectangle | None = None
        self.floors = [Rectangle(0, 0, x, y)]
        corners = [(0.0, 0.0), (x, 0.0), (x, y), (0.0, y)]
        if notch is not None:
            a, b = x - notch[0], y - notch[1]
            self.notch = Rectangle(a, b, x, y)
            self.floors = [Rectangle(0, 0, x, b), Rectangle(0, b, a, y)]
            corners[2:3] = [(x, b), (a, b), (a, y)]
        self.walls = [
            Wall(Frame(x0, y0, yaw=math.atan2(y1 - y0, x1 - x0)), math.hypot(x1 - x0, y1 - y0), [])
            for (x0, y0), (x1, y1) in pairwise([*corners, corners[0]])
        ]

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
            is_taken = any(
                start < b + _GAP and a < end + _GAP and (zone == other or "full" in (zone, other))
                for a, b, other in wall.taken
            )
            fits = self.claim if depth else self.contains
            if room > 0 and not is_taken and fits(area):
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


_COLUMNS = ("x", "y", "z", "width", "depth", "height")
_TERM = re.compile(r"([+-]?)(?=[\da-z])([\d.]*)([a-z]*)")
_SIGNS = {"": ((1, 1),), "x": ((-1, 1), (1, 1)), "xy": ((-1, -1), (-1, 1), (1, -1), (1, 1))}
"""Signs of x and y by the column `mirror`."""

_SHAPES = {
    "box": creation.box((1, 1, 1)),
    "cylinder": creation.cylinder(0.5, 1.0, sections=16),
    "prism": creation.cylinder(0.5, 1.0, sections=6),
    "ball": creation.icosphere(subdivisions=2, radius=0.5),
}
"""Unit shapes: each fills the cube of side 1 around the origin; cylinder and prism are upright."""

_PARTS = {
    key: [(mirror, list(rows)) for mirror, rows in groupby(found, itemgetter("mirror"))]
    for key, found in groupby(read_table("synthrooms_parts"), itemgetter("key"))
}
"""Rows of the table by key, those that are mirrored together."""


class Part(NamedTuple):
    """Triangles of one material of one item.

    Attributes:
        item: Position in `Room.items`.
        material: Material of the surface.
        triangles: ``(n, 3, 3)`` corners in meters.
    """

    item: int
    material: Material
    triangles: NDArray[np.float64]


class Light(NamedTuple):
    """A rectangular lamp that shines to one side.

    Attributes:
        center: ``(3,)`` in meters.
        half_sides: ``(2, 3)`` vectors from the center to the middle of two sides.
        normal: ``(3,)`` unit vector it shines along.
        intensity: Intensity along the normal; it falls with the cosine (Lambertian emitter).
    """

    center: NDArray[np.float64]
    half_sides: NDArray[np.float64]
    normal: NDArray[np.float64]
    intensity: float


class Item:
    """One labeled object, composed of parts.

    Args:
        parts: Parts of the room, to which those of the item are added.
        index: Position in `Room.items`.
        frame: Place of the item; all parts are given in this frame.
    """

    def __init__(self, parts: list[Part], index: int, frame: Frame) -> None:
        self._parts, self._index, self._frame = parts, index, frame
        self._values: dict[str, Any] = {"": 1.0}

    def add(
        self,
        shape: str,
        material: Material,
        center: tuple[float, float, float],
        size: Sequence[float],
        yaw: float = 0.0,
    ) -> None:
        """Add one of `_SHAPES`, scaled to `size` and rotated by `yaw` about its own vertical."""
        place = self._frame.at(*center, yaw)
        cos, sin = math.cos(place.yaw), math.sin(place.yaw)
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        corners = np.array(_SHAPES[shape].triangles) * size @ rotation.T + np.array(place[:3])
        self._parts.append(Part(self._index, material, corners))

    def put(self, *keys: str, **values: Any) -> None:
        """Add the parts of keys of the table.

        Args:
            *keys: Keys of the rows.
            **values: Sizes in meters and materials that the rows name; they are kept for the parts
                that follow.
        """
        self._values |= values
        for mirror, rows in (group for key in keys for group in _PARTS[key]):
            for sign_x, sign_y in _SIGNS[mirror]:
                for row in rows:
                    name, _, shade = row["material"].partition(":")
                    material = self._values[name]
                    material = material.shaded(float(shade)) if shade else material
                    x, y, z, *size = map(self._sum, (row[column] for column in _COLUMNS))
                    yaw = math.radians(float(row["degrees"] or 0))
                    self.add(row["shape"], material, (sign_x * x, sign_y * y, z), size, yaw)

    def _sum(self, text: str) -> float:
        """Return the value of a sum such as ``0.5wide-0.03``."""
        terms = _TERM.findall(text)
        return sum(
            float(f"{sign}{factor or 1}") * self._values[name] for sign, factor, name in terms
        )


class Room:
    """A room that is being furnished.

    Args:
        rng: Source of randomness.
        plan: Floor plan, with occupied places.

    Attributes:
        palette: Colors of the room.
        items: Class name of every item.
        parts: Parts of all items.
        lights: Lamps and windows that shine.
        reflectance: ``(3,)`` mean albedo of floor, ceiling and walls.
    """

    def __init__(self, rng: np.random.Generator, plan: FloorPlan) -> None:
        self.rng, self.plan, self.palette = rng, plan, Palette(rng)
        self.items: list[str] = []
        self.parts: list[Part] = []
        self.lights: list[Light] = []
        self.reflectance = np.zeros(3)

    def item(self, class_name: str, frame: Frame) -> Item:
        """Begin a new item of a class at a place."""
        self.items.append(class_name)
        return Item(self.parts, len(self.items) - 1, frame)

    def chance(self, probability: float) -> bool:
        """Return True with a probability."""
        return bool(self.rng.random() < probability)

    def pick(self, *shares: float) -> int:
        """Draw an index with the given shares."""
        return int(self.rng.choice(len(shares), p=np.asarray(shares) / np.sum(shares)))

    def sizes(self, *limits: Limits) -> list[float]:
        """Draw sizes uniformly between their limits, in order."""
        return [self.rng.uniform(*between) for between in limits]

    def count(self, least: int, most: int) -> int:
        """Draw an integer between two limits, inclusive."""
        return int(self.rng.integers(least, most + 1))
