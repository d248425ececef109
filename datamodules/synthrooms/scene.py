"""Room types, sizes and furnishing."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from datamodules.synthrooms import clutter, furniture, structure
from datamodules.synthrooms.layout import FloorPlan, NoPlaceError
from datamodules.synthrooms.materials import Palette
from datamodules.synthrooms.room import Room

_HEIGHTS = (2.5, 3.3)
_L_SHAPED = 0.35


class RoomType(NamedTuple):
    """Share of rooms, and limits of the long and the short side in meters."""

    share: float
    long: tuple[float, float]
    short: tuple[float, float]


ROOM_TYPES = {
    "office": RoomType(0.36, (4.0, 6.0), (3.4, 5.0)),
    "hallway": RoomType(0.1, (6.0, 8.5), (2.7, 3.4)),
    "conferenceRoom": RoomType(0.12, (5.0, 7.0), (4.0, 5.5)),
    "lounge": RoomType(0.09, (4.5, 6.5), (4.0, 5.5)),
    "storage": RoomType(0.06, (3.6, 5.0), (3.2, 4.2)),
    "WC": RoomType(0.04, (3.4, 4.6), (3.0, 3.8)),
    "copyRoom": RoomType(0.05, (3.8, 5.0), (3.2, 4.4)),
    "lobby": RoomType(0.06, (5.5, 7.5), (4.5, 6.0)),
    "pantry": RoomType(0.05, (3.8, 5.2), (3.2, 4.4)),
    "openspace": RoomType(0.04, (6.0, 8.0), (5.0, 6.5)),
    "auditorium": RoomType(0.03, (6.5, 8.5), (5.5, 7.0)),
}
"""Room types of Stanford2D3DS."""

_PROGRAM: tuple[tuple[Callable[[Room], None], float, int, int], ...] = (
    (structure.add_column, 0.75, 1, 2),
    (structure.add_door, 1.0, 1, 2),
    (furniture.add_bookcase, 0.85, 1, 2),
    (furniture.add_board, 0.9, 1, 2),
    (structure.add_window, 0.95, 1, 2),
    (furniture.add_sofa, 0.85, 1, 2),
    (structure.add_beams, 0.75, 1, 1),
    (clutter.add_lamp, 1.0, 1, 2),
    (furniture.add_table, 0.95, 1, 2),
    (furniture.add_desk, 0.75, 1, 2),
    (furniture.add_chair, 0.8, 1, 3),
    (clutter.add_floor_clutter, 1.0, 2, 5),
    (clutter.add_wall_clutter, 0.9, 1, 3),
)
"""Furniture in order of placement: function, share of rooms, smallest and largest number."""


def draw_room_type(rng: np.random.Generator) -> str:
    """Draw one of `ROOM_TYPES`."""
    shares = np.array([kind.share for kind in ROOM_TYPES.values()])
    return list(ROOM_TYPES)[rng.choice(len(shares), p=shares / shares.sum())]


def shell(rng: np.random.Generator, plan: FloorPlan) -> Room:
    """Build an empty room: floor, ceiling and walls."""
    room = Room(rng, plan, Palette(rng))
    materials = [
        add(room) for add in (structure.add_floor, structure.add_ceiling, structure.add_walls)
    ]
    room.reflectance = np.mean([material.color**2 for material in materials], axis=0)
    return room


def furnish(rng: np.random.Generator, room_type: str) -> Room:
    """Build a furnished room.

    Args:
        rng: The room's source of randomness.
        room_type: One of `ROOM_TYPES`.
    """
    room = shell(rng, _draw_plan(rng, ROOM_TYPES[room_type]))
    for add, share, least, most in _PROGRAM:
        if room.chance(share):
            for _ in range(room.count(least, most)):
                with suppress(NoPlaceError):
                    add(room)
    return room


def _draw_plan(rng: np.random.Generator, kind: RoomType) -> FloorPlan:
    long, short = rng.uniform(*kind.long), rng.uniform(*kind.short)
    size = (long, short, rng.uniform(*_HEIGHTS))
    if rng.random() >= _L_SHAPED or short < 3.2:
        return FloorPlan(size)
    return FloorPlan(size, notch=(long * rng.uniform(0.25, 0.5), short * rng.uniform(0.25, 0.45)))
