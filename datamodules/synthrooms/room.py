"""Rooms under construction: items composed of boxes, cylinders and balls, with materials.

``tables/synthrooms_parts.csv`` is the table of parts of all furniture. A position or size in it
is a sum such as ``0.5wide-0.03``, in meters and in values of the piece. `mirror` repeats rows at
−x (``x``), or at −x and −y (``xy``). ``body:0.6`` is the material `body`, shaded by 0.6.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from functools import cache, partialmethod
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from trimesh import creation

from datamodules.synthrooms.layout import FloorPlan, Frame
from datamodules.synthrooms.materials import Material, Palette
from datamodules.tables import read_table

_SHAPES = {
    "box": creation.box((1, 1, 1)),
    "cylinder": creation.cylinder(0.5, 1.0, sections=16),
    "prism": creation.cylinder(0.5, 1.0, sections=6),
    "ball": creation.icosphere(subdivisions=2, radius=0.5),
}
"""Unit shapes: each fills the cube of side 1 around the origin; cylinder and prism are upright."""

_SIGNS = {"": ((1, 1),), "x": ((-1, 1), (1, 1)), "xy": ((-1, -1), (-1, 1), (1, -1), (1, 1))}
"""Signs of x and y by the column `mirror`."""

_Row = dict[str, str]
_Triple = tuple[float, float, float]


@cache
def _part_table() -> dict[str, list[tuple[str, list[_Row]]]]:
    """Return the rows of the table by key, as runs of rows that are mirrored together."""
    return {
        key: [(mirror, list(run)) for mirror, run in groupby(rows, lambda row: row["mirror"])]
        for key, rows in groupby(read_table("synthrooms_parts"), lambda row: row["key"])
    }


@cache
def _terms(text: str) -> list[tuple[float, str]]:
    """Return factor and name of each term of a sum, e.g. ``[(0.5, "wide"), (-0.03, "")]``."""
    found = re.findall(r"([+-]?)([\d.]*)([a-z]*)", text)[:-1]  # the last match is empty
    return [(float(f"{sign}{factor or 1}"), name) for sign, factor, name in found]


class RoomPart(NamedTuple):
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


@dataclass
class RoomItem:
    """One labeled object, composed of parts.

    Attributes:
        parts: Parts of the room, to which those of the item are added.
        index: Position in `Room.items`.
        frame: Place of the item; all parts are given in this frame.
    """

    parts: list[RoomPart]
    index: int
    frame: Frame

    def add(
        self, shape: str, material: Material, center: _Triple, size: _Triple, yaw: float = 0.0
    ) -> None:
        """Add one of `_SHAPES`, scaled to `size` and rotated by `yaw` about its own vertical."""
        place = self.frame.at(*center, yaw)
        cos, sin = math.cos(place.yaw), math.sin(place.yaw)
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        unit = np.array(_SHAPES[shape].triangles, np.float64)
        corners = unit * size @ rotation.T + np.array(place[:3])
        self.parts.append(RoomPart(self.index, material, corners))

    box = partialmethod(add, "box")
    cylinder = partialmethod(add, "cylinder")
    ball = partialmethod(add, "ball")

    def put(self, key: str, **values: Any) -> None:
        """Add the parts of a key of the table.

        Args:
            key: Key of the rows.
            **values: Sizes in meters and materials that the rows name.
        """

        def size(row: _Row, column: str) -> float:
            terms = _terms(row[column])
            return sum(factor * (values[name] if name else 1.0) for factor, name in terms)

        for mirror, rows in _part_table()[key]:
            for sign_x, sign_y in _SIGNS[mirror]:
                for row in rows:
                    name, _, shade = row["material"].partition(":")
                    material = values[name].shaded(float(shade)) if shade else values[name]
                    center = (sign_x * size(row, "x"), sign_y * size(row, "y"), size(row, "z"))
                    extent = (size(row, "width"), size(row, "depth"), size(row, "height"))
                    yaw = math.radians(float(row["degrees"] or 0))
                    self.add(row["shape"], material, center, extent, yaw)


@dataclass
class Room:
    """A room that is being furnished.

    Attributes:
        rng: Source of randomness.
        plan: Floor plan, with occupied places.
        palette: Colors of the room.
        items: Class name of every item.
        parts: Parts of all items.
        lights: Lamps and windows that shine.
        reflectance: ``(3,)`` mean albedo of floor, ceiling and walls.
    """

    rng: np.random.Generator
    plan: FloorPlan
    palette: Palette
    items: list[str] = field(default_factory=list)
    parts: list[RoomPart] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    reflectance: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def item(self, class_name: str, frame: Frame) -> RoomItem:
        """Begin a new item of a class at a place."""
        self.items.append(class_name)
        return RoomItem(self.parts, len(self.items) - 1, frame)

    def chance(self, probability: float) -> bool:
        """Return True with a probability."""
        return bool(self.rng.random() < probability)

    def pick(self, *shares: float) -> int:
        """Draw an index with the given shares."""
        return int(self.rng.choice(len(shares), p=np.asarray(shares) / np.sum(shares)))

    def sizes(self, **limits: tuple[float, float]) -> dict[str, Any]:
        """Draw sizes uniformly between their limits, in order."""
        return {name: self.rng.uniform(*between) for name, between in limits.items()}

    def count(self, least: int, most: int) -> int:
        """Draw an integer between two limits, inclusive."""
        return int(self.rng.integers(least, most + 1))
