"""Chairs and sofas; their backs are at +y."""

from __future__ import annotations

import numpy as np

from datamodules.synthrooms.layout import Frame, Rectangle
from datamodules.synthrooms.palette import Material, Pattern
from datamodules.synthrooms.room import Item, Room

__all__ = ["add_chair", "add_chair_at", "add_sofa"]


def add_chair(room: Room) -> None:
    """Add a chair somewhere in the open, turned anyhow."""
    frame = room.plan.in_the_open(room.rng, 0.6, 0.6)
    if frame is not None:
        _build_chair(room, frame.at(0, 0, yaw=room.rng.uniform(0, 2 * np.pi)))


def add_chair_at(room: Room, frame: Frame) -> None:
    """Add a chair at a place if nothing is in the way."""
    area = Rectangle.around(Frame(frame.x, frame.y), (-0.24, 0.24), (-0.24, 0.24))
    if room.plan.contains(area, margin=0.2) and room.plan.is_free(area):
        room.plan.take(area)
        _build_chair(room, frame)


def _build_chair(room: Room, frame: Frame) -> None:
    """A chair: four legs, a star base, a sledge, or a tub with arms; with or without armrests."""
    rng = room.rng
    chair = room.item("chair", frame)
    design = room.pick((0.35, 0.3, 0.15, 0.2))
    cover = room.palette.material()
    frame_material = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
    wide, seat = rng.uniform(0.44, 0.56), rng.uniform(0.42, 0.5)
    back = rng.uniform(0.4, 0.6)
    thick = rng.uniform(0.05, 0.11)
    if design == 3:
        chair.cylinder(cover, (0, 0, seat / 2), (wide + 0.1, wide + 0.1, seat))
        chair.box(cover, (0, wide / 2, seat), (wide + 0.15, 0.14, seat + 0.35))
        for side in (-1, 1):
            chair.box(cover, (side * wide / 2, 0.03, seat * 0.75), (0.12, wide, seat + 0.15))
        return
    chair.box(cover, (0, 0, seat), (wide, wide, thick))
    gap = rng.uniform(0, 0.12)
    chair.box(cover, (0, wide / 2 - 0.02, seat + gap + back / 2), (wide * 0.95, 0.06, back))
    _add_base(chair, frame_material, design, wide, seat)
    for side in (-1, 1):
        x = side * (wide / 2 - 0.03)
        chair.box(frame_material, (x, wide / 2 - 0.02, seat + 0.1), (0.04, 0.04, 0.25))
    if room.chance(0.4):
        for side in (-1, 1):
            x = side * (wide / 2 + 0.02)
            chair.box(frame_material, (x, 0, seat + 0.22), (0.06, wide * 0.8, 0.04))
            chair.box(frame_material, (x, -0.1, seat + 0.1), (0.04, 0.04, 0.24))


def _add_base(chair: Item, material: Material, design: int, wide: float, seat: float) -> None:
    spread = wide / 2 - 0.03
    if design == 0:
        chair.legs(material, (spread, spread), seat, 0.045)
    elif design == 1:
        chair.cylinder(material, (0, 0, seat / 2 + 0.03), (0.08, 0.08, seat - 0.06))
        for k in range(3):
            chair.box(material, (0, 0, 0.06), (wide + 0.12, 0.06, 0.06), yaw=k * np.pi / 3)
    else:
        for side in (-1, 1):
            chair.box(material, (side * spread, 0, 0.02), (0.045, wide, 0.04))
            chair.box(material, (side * spread, -spread, seat / 2), (0.045, 0.045, seat))


def add_sofa(room: Room) -> None:
    """Add a sofa at a wall or in the open: with arms, a bench, round arms, or around a corner."""
    rng = room.rng
    design = room.pick((0.45, 0.15, 0.2, 0.2))
    wide, deep = rng.uniform(1.5, 2.4), rng.uniform(0.8, 1.0)
    reach = deep + (0.7 if design == 3 else 0.0)
    frame = room.plan.against_wall(rng, wide, reach, "low")
    if frame is not None:
        frame = frame.at(0, deep / 2 + 0.03, yaw=np.pi)
    else:
        design = 0 if design == 3 else design
        frame = room.plan.in_the_open(rng, wide, deep)
        if frame is None:
            return
        frame = frame.at(0, 0, yaw=np.pi * room.count(0, 1))
    sofa = room.item("sofa", frame)
    cover = room.palette.material(Pattern.PLAIN, Pattern.SPECKLE, Pattern.STRIPES)
    cushion = cover if room.chance(0.6) else room.palette.material(Pattern.PLAIN, Pattern.SPECKLE)
    seat = rng.uniform(0.36, 0.46)
    sofa.box(cover, (0, 0, seat / 2 + 0.03), (wide, deep, seat - 0.06))
    if design == 3:
        sofa.box(cover, (wide / 2 - 0.4, -deep / 2 - 0.33, seat / 2 + 0.05), (0.8, 0.7, seat))
    back = rng.uniform(0.4, 0.52)
    sofa.box(cover, (0, deep / 2 - 0.11, seat + back / 2), (wide, 0.22, back))
    arm = _add_arms(room, sofa, cover, design, (wide, deep, seat))
    seats = max(1, round((wide - 2 * arm) / 0.7))
    pitch = (wide - 2 * arm) / seats
    for k in range(seats):
        x = (k + 0.5 - seats / 2) * pitch
        sofa.box(cushion, (x, -0.1, seat + 0.06), (pitch - 0.02, deep - 0.24, 0.12))
        if room.chance(0.7):
            sofa.box(cushion, (x, deep / 2 - 0.26, seat + 0.3), (pitch - 0.06, 0.12, 0.36))


def _add_arms(
    room: Room, sofa: Item, cover: Material, design: int, size: tuple[float, float, float]
) -> float:
    """Arms of a sofa; returns how wide one is."""
    wide, deep, seat = size
    if design == 1:
        return 0.0
    arm = room.rng.uniform(0.14, 0.24)
    for side in (-1, 1):
        if design == 3 and side == 1:
            continue
        x = side * (wide / 2 - arm / 2)
        if design == 2:
            sofa.ball(cover, (x, 0, seat + 0.12), (arm * 1.3, deep, 0.3))
        sofa.box(cover, (x, 0, seat / 2 + 0.12), (arm, deep, seat + 0.18))
    return arm
