"""Doors and windows."""

from __future__ import annotations

import numpy as np

from datamodules.synthrooms.layout import Frame
from datamodules.synthrooms.palette import Material, Pattern
from datamodules.synthrooms.room import Item, Light, Room

__all__ = ["add_door", "add_window"]

_SKY = ((0.5, 0.65), (0.05, 0.4), (0.8, 1.0))
_LIT_SIDE = 0.16  # metres in front of the glass, past frame and sill


def _add_frame(item: Item, material: Material, wide: float, bottom: float, top: float) -> None:
    """Two posts and a lintel around an opening."""
    for x in (-wide / 2, wide / 2):
        item.box(material, (x, 0.045, (bottom + top) / 2), (0.08, 0.09, top - bottom + 0.08))
    item.box(material, (0, 0.045, top + 0.01), (wide + 0.08, 0.09, 0.08))


def add_door(room: Room) -> None:
    """Add a door: plain, panelled, glazed or with two leaves, in a frame, with a handle."""
    rng = room.rng
    design = room.pick((0.3, 0.3, 0.2, 0.2))
    wide = rng.uniform(1.4, 1.9) if design == 3 else rng.uniform(0.85, 1.15)
    top = min(room.plan.height - 0.2, rng.uniform(2.0, 2.3))
    frame = room.plan.against_wall(rng, wide + 0.15, 0.85, "full")
    if frame is None:
        return
    door = room.item("door", frame)
    leaf = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
    trim = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
    door.box(leaf, (0, 0.02, top / 2), (wide, 0.04, top))
    _add_frame(door, trim, wide, 0, top)
    if design == 1:
        inset = leaf.shaded(rng.uniform(0.6, 0.85))
        for z, share in ((0.27, 0.36), (0.72, 0.4)):
            door.box(inset, (0, 0.042, top * z), (wide * 0.68, 0.008, top * share))
    elif design == 2:
        glass = room.palette.material(Pattern.PLAIN, color=room.palette.hsv(*_SKY))
        door.box(glass, (0, 0.042, top * 0.68), (wide * 0.6, 0.008, top * 0.45))
    elif design == 3:
        door.box(leaf.shaded(0.4), (0, 0.042, top / 2), (0.025, 0.008, top))
    metal = trim.shaded(0.5)
    side = 0.08 if design == 3 else wide * 0.4
    door.box(metal, (side, 0.07, 1.02), (0.14, 0.06, 0.04))


def add_window(room: Room) -> None:
    """Add a window: outside light or frosted glass, one to four panes, a sill, maybe a blind."""
    rng, height = room.rng, room.plan.height
    tall = room.chance(0.25)
    wide = rng.uniform(1.2, 2.6)
    bottom = rng.uniform(0.1, 0.3) if tall else rng.uniform(0.8, 1.05)
    top = min(height - 0.25, bottom + rng.uniform(1.0, 1.5) + (0.7 if tall else 0))
    frame = room.plan.against_wall(
        rng, wide + 0.15, 0.25 if tall else 0, "full" if tall else "high"
    )
    if frame is None:
        return
    window = room.item("window", frame)
    trim = room.palette.material(Pattern.PLAIN)
    middle, high = (bottom + top) / 2, top - bottom
    bright = room.chance(0.75)
    window.box(_glass(room, bright), (0, 0.01, middle), (wide, 0.02, high))
    _add_frame(window, trim, wide, bottom, top)
    window.box(trim, (0, 0.08, bottom - 0.03), (wide + 0.2, 0.16, 0.05))
    panes = room.count(1, 4)
    for k in range(1, panes):
        window.box(trim, (wide * (k / panes - 0.5), 0.035, middle), (0.05, 0.05, high))
    if room.chance(0.4):
        window.box(trim, (0, 0.035, bottom + high * 0.66), (wide, 0.05, 0.05))
    if room.chance(0.25):
        _add_blind(room, window, wide, bottom, top)
    if bright:
        _shine(room, frame, middle, wide, high)


def _glass(room: Room, bright: bool) -> Material:
    if bright:
        return room.palette.material(
            Pattern.OUTSIDE,
            color=room.palette.hsv(*_SKY),
            second=room.palette.hsv((0.05, 0.45), (0.05, 0.6), (0.25, 0.7)),
            frequency=(0.5, 1.5),
            emission=room.rng.uniform(0.3, 0.6),
            unscanned=room.chance(0.25),
        )
    return room.palette.material(Pattern.PLAIN, Pattern.SPECKLE, frequency=(0.5, 2))


def _add_blind(room: Room, window: Item, wide: float, bottom: float, top: float) -> None:
    material = room.palette.material(Pattern.PLAIN)
    lowest = top - (top - bottom) * room.rng.uniform(0.2, 0.7)
    for z in np.arange(top - 0.04, lowest, -0.09):
        window.box(material, (0, 0.075, float(z)), (wide * 0.97, 0.01, 0.06))


def _shine(room: Room, frame: Frame, middle: float, wide: float, high: float) -> None:
    """Daylight through the window, a lamp of its size."""
    center = np.array(frame.at(0, _LIT_SIDE, middle)[:3])
    along = np.array([np.cos(frame.yaw), np.sin(frame.yaw), 0.0])
    inward = np.array([-np.sin(frame.yaw), np.cos(frame.yaw), 0.0])
    sides = np.stack([along * wide * 0.4, [0, 0, high * 0.4]])
    room.lights.append(Light(center, sides, inward, room.rng.uniform(0.4, 1.0) * wide * high))
