"""A room being furnished: items made of boxes, cylinders and balls, with their materials."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
import trimesh

from datamodules.synthrooms.layout import FloorPlan, Frame
from datamodules.synthrooms.palette import Material, Palette

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["UNKNOWN", "Item", "Light", "Part", "Room"]

UNKNOWN = "<UNK>"
"""Class of what nobody labelled."""

Shape = Literal["box", "cylinder", "prism", "ball"]
Triple = tuple[float, float, float]


@functools.cache
def _unit_shape(shape: Shape) -> NDArray[np.float64]:
    """Triangles ``(n, 3, 3)`` of a shape that fills the cube of side 1 around the origin."""
    mesh = {
        "box": lambda: trimesh.creation.box((1, 1, 1)),
        "cylinder": lambda: trimesh.creation.cylinder(0.5, 1.0, sections=16),
        "prism": lambda: trimesh.creation.cylinder(0.5, 1.0, sections=6),
        "ball": lambda: trimesh.creation.icosphere(subdivisions=2, radius=0.5),
    }[shape]()
    return np.array(mesh.triangles, np.float64)


class Part(NamedTuple):
    """Triangles of one material of one item.

    Attributes:
        item: Position in `Room.items`.
        material: Its surface.
        triangles: ``(n, 3, 3)`` corners in metres.
    """

    item: int
    material: Material
    triangles: NDArray[np.float64]


class Light(NamedTuple):
    """A rectangular lamp that shines to one side.

    Attributes:
        center: ``(3,)`` in metres.
        half_sides: ``(2, 3)`` vectors from the centre to the middle of two sides.
        normal: ``(3,)`` unit vector it shines along.
        intensity: Along the normal; it falls with the cosine, as a Lambertian emitter's.
    """

    center: NDArray[np.float64]
    half_sides: NDArray[np.float64]
    normal: NDArray[np.float64]
    intensity: float


class Item:
    """One labelled object, put together from parts.

    Args:
        parts: The room's parts, to which its own are added.
        index: Position in `Room.items`.
        frame: Where it stands; all parts are given in this frame.
    """

    def __init__(self, parts: list[Part], index: int, frame: Frame) -> None:
        self._parts = parts
        self._index = index
        self._frame = frame

    def box(self, material: Material, center: Triple, size: Triple, yaw: float = 0.0) -> None:
        """Add a box of `size`, turned by `yaw` about its own vertical."""
        self._add("box", material, center, size, yaw)

    def cylinder(self, material: Material, center: Triple, size: Triple) -> None:
        """Add an upright cylinder of diameters ``size[0]``, ``size[1]`` and height ``size[2]``."""
        self._add("cylinder", material, center, size)

    def prism(self, material: Material, center: Triple, size: Triple) -> None:
        """Add an upright six-sided prism."""
        self._add("prism", material, center, size)

    def ball(self, material: Material, center: Triple, size: Triple) -> None:
        """Add an ellipsoid of diameters `size`."""
        self._add("ball", material, center, size)

    def legs(
        self, material: Material, spread: tuple[float, float], height: float, thick: float
    ) -> None:
        """Add four upright legs from the floor, ``±spread`` metres from the middle."""
        for x in (-spread[0], spread[0]):
            for y in (-spread[1], spread[1]):
                self.box(material, (x, y, height / 2), (thick, thick, height))

    def _add(
        self, shape: Shape, material: Material, center: Triple, size: Triple, yaw: float = 0.0
    ) -> None:
        place = self._frame.at(*center, yaw)
        cos, sin = math.cos(place.yaw), math.sin(place.yaw)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        triangles = _unit_shape(shape) * size @ turn.T + np.array(place[:3])
        self._parts.append(Part(self._index, material, triangles))


@dataclass
class Room:
    """A room and everything in it.

    Attributes:
        rng: Its source of randomness.
        plan: Floor plan, with what is taken.
        palette: Its colours.
        items: Class name of every item.
        parts: Parts of all items.
        lights: Lamps and windows that shine.
        reflectance: ``(3,)`` mean share of light that floor, ceiling and walls throw back.
    """

    rng: np.random.Generator
    plan: FloorPlan
    palette: Palette
    items: list[str] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    reflectance: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    def item(self, class_name: str, frame: Frame) -> Item:
        """Begin a new item of a class at a place."""
        self.items.append(class_name)
        return Item(self.parts, len(self.items) - 1, frame)

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return bool(self.rng.random() < probability)

    def pick(self, shares: Sequence[float]) -> int:
        """An index, drawn with the given shares."""
        return int(self.rng.choice(len(shares), p=np.asarray(shares) / np.sum(shares)))

    def count(self, least: int, most: int) -> int:
        """An integer between two limits, both included."""
        return int(self.rng.integers(least, most + 1))
