"""Clutter on tables, floor and walls, and lamps; a few items are unlabeled.

In a frame against a wall x runs along the wall and y into the room; free-standing furniture has its
back at +y. Items that do not fit raise `NoPlaceError`.
"""

from __future__ import annotations

import math

import numpy as np

from datamodules.stanford2d3ds.files import UNKNOWN_CLASS
from datamodules.synthrooms.layout import Frame
from datamodules.synthrooms.materials import Pattern
from datamodules.synthrooms.room import Light, Room, RoomItem

_UNLABELED = 0.12


def _new(room: Room, frame: Frame) -> RoomItem:
    return room.item(UNKNOWN_CLASS if room.chance(_UNLABELED) else "clutter", frame)


def add_desk_things(room: Room, frame: Frame, size: tuple[float, float, float]) -> None:
    """Put up to four items on a table top of ``(width, depth, height)`` meters."""
    wide, deep, high = size
    number = room.count(0, 4)
    for k in range(number):
        x = wide * 0.8 * ((k + 0.5) / number - 0.5)
        y = deep * room.rng.uniform(-0.2, 0.2)
        heading = room.rng.normal(0, 0.4)
        _build_desk_thing(room, _new(room, frame.at(x, y, high, yaw=heading)))


def _build_desk_thing(room: Room, thing: RoomItem) -> None:
    """Build a monitor, a pile of books, a vase, a box, or a desk lamp."""
    rng = room.rng
    material = room.palette.material()
    kind = room.pick((0.4, 0.2, 0.15, 0.15, 0.1))
    if kind == 0:
        wide, high = rng.uniform(0.45, 0.65), rng.uniform(0.32, 0.42)
        plastic = room.palette.material(Pattern.PLAIN)
        screen, z = material.shaded(0.8), 0.12 + high / 2
        thing.box(plastic, (0, 0, z), (wide, 0.05, high))
        thing.box(screen, (0, -0.027, z), (wide - 0.05, 0.006, high - 0.05))
        thing.box(plastic, (0, 0.02, 0.08), (0.06, 0.05, 0.16))
        thing.box(plastic, (0, 0, 0.01), (0.24, 0.18, 0.02))
    elif kind == 1:
        for k in range(room.count(3, 6)):
            cover, yaw = room.palette.material(Pattern.PLAIN), rng.uniform(-0.4, 0.4)
            thing.box(cover, (0, 0, 0.025 + 0.05 * k), (0.32, 0.24, 0.05), yaw)
    elif kind == 2:
        thing.cylinder(material, (0, 0, 0.12), (0.14, 0.14, 0.24))
        thing.ball(room.palette.material(Pattern.SPECKLE), (0, 0, 0.36), (0.34, 0.34, 0.3))
    elif kind == 3:
        high, wide, deep = rng.uniform((0.18, 0.2, 0.2), (0.36, 0.42, 0.34))
        thing.box(material, (0, 0, high / 2), (wide, deep, high))
    else:
        thing.cylinder(material, (0, 0, 0.015), (0.18, 0.18, 0.03))
        thing.cylinder(material, (0, 0, 0.2), (0.03, 0.03, 0.4))
        thing.cylinder(room.palette.material(Pattern.PLAIN), (0, 0, 0.44), (0.26, 0.26, 0.18))


def add_floor_clutter(room: Room) -> None:
    """Add an item on the floor."""
    rng = room.rng
    size = rng.uniform(0.4, 0.65)
    if room.chance(0.6):
        frame = room.plan.against_wall(rng, size + 0.1, size, "low").at(0, size / 2 + 0.02)
    else:
        frame = room.plan.in_the_open(rng, size, size)
    kind = room.pick((0.25, 0.2, 0.1, 0.25, 0.1, 0.1))
    _build_floor_thing(room, _new(room, frame), kind, size)


def _build_floor_thing(room: Room, thing: RoomItem, kind: int, size: float) -> None:
    """Build boxes, a plant, a bin, a cabinet, a standing lamp, or a ball."""
    rng, material = room.rng, room.palette.material
    if kind == 0:
        for k in range(room.count(1, 3)):
            side = size * (0.95 - 0.15 * k)
            center = (0, 0, size * (0.35 + 0.7 * k))
            yaw = rng.normal(0, 0.08)
            thing.box(material(), center, (side, side, size * 0.7), yaw)
    elif kind == 1:
        thing.cylinder(material(), (0, 0, 0.18), (size * 0.7, size * 0.7, 0.36))
        leaves = material(Pattern.SPECKLE, frequency=(3, 8))
        for z, wide in ((0.6, 0.85), (0.95, 1.0), (1.25, 0.75)):
            x, y = rng.uniform(-0.05, 0.05, 2)
            thing.ball(leaves, (x, y, z), (size * wide, size * wide, 0.5))
    elif kind == 2:
        thing.cylinder(material(), (0, 0, size * 0.5), (size * 0.7, size * 0.7, size))
    elif kind == 3:
        body, high = material(), rng.uniform(0.6, 1.25)
        thing.box(body, (0, 0, high / 2), (size, size, high))
        for z in (0.25, 0.5, 0.75):
            thing.box(body.shaded(0.6), (0, 0, high * z), (size + 0.01, size + 0.01, 0.02))
    elif kind == 4:
        stand, shade = material(), material(Pattern.PLAIN)
        thing.cylinder(stand, (0, 0, 0.03), (0.36, 0.36, 0.06))
        thing.cylinder(stand, (0, 0, 0.75), (0.05, 0.05, 1.5))
        thing.cylinder(shade, (0, 0, 1.6), (size * 0.8, size * 0.8, 0.32))
    else:
        thing.ball(material(), (0, 0, size / 2), (size, size, size))


def add_wall_clutter(room: Room) -> None:
    """Hang an item on a wall: a picture, a screen, a wall cupboard, or a clock."""
    rng = room.rng
    wide, high = rng.uniform(0.5, 1.3), rng.uniform(0.45, 0.9)
    kind = room.pick((0.4, 0.25, 0.2, 0.15))
    frame = room.plan.against_wall(rng, wide, 0, "high")
    z = min(rng.uniform(1.45, 1.75), room.plan.height - high / 2 - 0.1)
    thing = _new(room, frame)
    face, trim = room.palette.material(), room.palette.material(Pattern.PLAIN)
    if kind == 0:
        thing.box(trim, (0, 0.015, z), (wide, 0.03, high))
        thing.box(face, (0, 0.033, z), (wide - 0.09, 0.006, high - 0.09))
    elif kind == 1:
        thing.box(trim, (0, 0.04, z), (wide, 0.08, wide * 0.58))
        thing.box(face.shaded(0.4), (0, 0.082, z), (wide - 0.06, 0.004, wide * 0.58 - 0.06))
    elif kind == 2:
        thing.box(face, (0, 0.16, z), (wide, 0.32, high))
        thing.box(trim, (0, 0.322, z), (0.02, 0.006, high))
    else:
        thing.ball(trim, (0, 0.02, z), (0.5, 0.06, 0.5))
        thing.ball(face, (0, 0.03, z), (0.42, 0.06, 0.42))


def add_lamp(room: Room) -> None:
    """Add a ceiling lamp: a panel, a long tube, a disc, or a hanging ball; it lights the room."""
    rng, plan = room.rng, room.plan
    area = plan.floors[rng.integers(len(plan.floors))]
    x = area.x0 + (area.x1 - area.x0) * rng.uniform(0.3, 0.7)
    y = area.y0 + (area.y1 - area.y0) * rng.uniform(0.3, 0.7)
    if any(math.hypot(x - lamp.center[0], y - lamp.center[1]) < 1.3 for lamp in room.lights):
        return
    design = room.pick((0.35, 0.3, 0.2, 0.15))
    size = ((0.6, 0.6), (1.4, 0.25), (0.5, 0.5), (0.4, 0.4))[design]
    drop = rng.uniform(0.3, 0.6) if design == 3 else 0.07
    z = plan.height - drop
    tint = room.palette.hsv((0.08, 0.16), (0, 0.15), (0.95, 1.0))
    glow = room.palette.material(Pattern.PLAIN, color=tint, emission=rng.uniform(1.0, 1.6))
    lamp = room.item("clutter", Frame(x, y))
    if design == 3:
        cord = room.palette.material(Pattern.PLAIN)
        lamp.ball(glow, (0, 0, z + 0.2), (0.4, 0.4, 0.4))
        lamp.cylinder(cord, (0, 0, plan.height - 0.1), (0.04, 0.04, 0.2))
    else:
        shape = "cylinder" if design == 2 else "box"
        lamp.add(shape, glow, (0, 0, z + 0.035), (*size, 0.07))
    sides = np.array([[size[0] * 0.45, 0, 0], [0, size[1] * 0.45, 0]])
    down = np.array([0.0, 0.0, -1.0])
    strength = rng.uniform(0.7, 1.3)
    room.lights.append(Light(np.array([x, y, z - 0.02]), sides, down, strength))
