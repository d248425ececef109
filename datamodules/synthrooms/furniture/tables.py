"""Tables, with what stands on them and the chairs around them."""

from __future__ import annotations

import numpy as np

from datamodules.synthrooms.furniture.clutter import add_desk_things
from datamodules.synthrooms.furniture.seating import add_chair_at
from datamodules.synthrooms.layout import Frame
from datamodules.synthrooms.palette import Pattern
from datamodules.synthrooms.room import Room

__all__ = ["add_desk", "add_table"]


def add_table(room: Room) -> None:
    """Add a table in the open: four legs, round, panel ends, or a trestle; with chairs around."""
    rng = room.rng
    design = room.pick((0.4, 0.2, 0.25, 0.15))
    wide, deep = rng.uniform(1.2, 2.4), rng.uniform(0.75, 1.2)
    if design == 1:
        wide = deep = rng.uniform(1.0, 1.5)
    turned = room.chance(0.5)
    footprint = (deep, wide) if turned else (wide, deep)
    frame = room.plan.in_the_open(rng, *footprint, gap=0.35)
    if frame is None:
        return
    frame = frame.at(0, 0, yaw=np.pi / 2 if turned else 0)
    _build_table(room, frame, design, wide, deep)
    seats = 1 + int(wide > 1.6)
    for side in (-1, 1):
        for x in (np.arange(seats) - (seats - 1) / 2) * wide / seats:
            if room.chance(0.7):
                away = side * (deep / 2 + rng.uniform(0.27, 0.4))
                turn = (0 if side > 0 else np.pi) + rng.normal(0, 0.25)
                add_chair_at(room, frame.at(float(x), away, yaw=turn))


def add_desk(room: Room) -> None:
    """Add a desk against a wall with a chair in front of it."""
    rng = room.rng
    wide, deep = rng.uniform(1.2, 1.9), rng.uniform(0.65, 0.85)
    frame = room.plan.against_wall(rng, wide, deep, "low")
    if frame is None:
        return
    _build_table(room, frame.at(0, deep / 2 + 0.02), 0 if room.chance(0.5) else 2, wide, deep)
    if room.chance(0.8):
        turn = rng.normal(0, 0.4)
        add_chair_at(room, frame.at(rng.uniform(-0.2, 0.2), deep + 0.33, yaw=turn))


def _build_table(room: Room, frame: Frame, design: int, wide: float, deep: float) -> None:
    rng = room.rng
    high = rng.uniform(0.68, 0.78)
    table = room.item("table", frame)
    top = room.palette.material()
    base = room.palette.material() if room.chance(0.5) else top
    if design == 1:
        table.cylinder(top, (0, 0, high), (wide, deep, 0.05))
        table.cylinder(base, (0, 0, high / 2), (0.14, 0.14, high))
        table.cylinder(base, (0, 0, 0.03), (0.65, 0.65, 0.06))
    else:
        table.box(top, (0, 0, high), (wide, deep, 0.05))
    if design == 0:
        thick = rng.uniform(0.05, 0.1)
        table.legs(base, (wide / 2 - 0.06, deep / 2 - 0.06), high, thick)
        table.box(base, (0, 0, high - 0.07), (wide - 0.15, deep - 0.15, 0.1))
    elif design == 2:
        for side in (-1, 1):
            table.box(base, (side * (wide / 2 - 0.05), 0, high / 2), (0.05, deep * 0.92, high))
        table.box(base, (0, deep * 0.3, high * 0.6), (wide * 0.92, 0.03, high * 0.6))
        drawers = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
        table.box(drawers, (wide * 0.3, 0, high * 0.45), (wide * 0.28, deep * 0.8, high * 0.75))
    elif design == 3:
        for side in (-1, 1):
            x = side * wide * 0.36
            table.box(base, (x, 0, high / 2), (0.09, 0.09, high))
            table.box(base, (x, 0, 0.03), (0.09, deep * 0.85, 0.06))
            table.box(base, (x, 0, high - 0.05), (0.09, deep * 0.85, 0.06))
        table.box(base, (0, 0, high * 0.35), (wide * 0.72, 0.05, 0.1))
    add_desk_things(room, frame, (wide, deep, high + 0.025))
