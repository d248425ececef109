"""Floor, ceiling, walls, columns and beams."""

from __future__ import annotations

import numpy as np

from datamodules.synthrooms.layout import Frame, Rectangle
from datamodules.synthrooms.palette import Material, Pattern
from datamodules.synthrooms.room import Item, Room

__all__ = ["add_beams", "add_ceiling", "add_column", "add_floor", "add_walls"]

_THICK = 0.1


def add_floor(room: Room) -> Material:
    """Add the floor, sometimes with a carpet or a border of another material.

    Returns:
        Its main material.
    """
    patterns = (Pattern.WOOD, Pattern.TILES, Pattern.SPECKLE, Pattern.PLAIN, Pattern.STRIPES)
    material = room.palette.material(*patterns, frequency=(1, 4))
    floor = room.item("floor", Frame(0, 0))
    for area in room.plan.floors:
        _add_slab(floor, area, material, z=-_THICK / 2)
    if room.chance(0.3):
        carpet = room.palette.material(Pattern.SPECKLE, Pattern.STRIPES, Pattern.PLAIN)
        x, y = room.plan.width * 0.4, room.plan.depth * 0.4
        size = (room.plan.width * 0.45, room.plan.depth * 0.4, 0.012)
        floor.box(carpet, (x, y, 0.006), size)
    return material


def add_ceiling(room: Room) -> Material:
    """Add the ceiling: plain, tiled or boarded.

    Returns:
        Its material.
    """
    color = room.palette.color() if room.chance(0.2) else room.palette.pale()
    patterns = (Pattern.PLAIN, Pattern.PLAIN, Pattern.TILES, Pattern.SPECKLE, Pattern.STRIPES)
    material = room.palette.material(*patterns, color=color, frequency=(1, 2.5))
    ceiling = room.item("ceiling", Frame(0, 0))
    for area in room.plan.floors:
        _add_slab(ceiling, area, material, z=room.plan.height + _THICK / 2)
    return material


def _add_slab(item: Item, area: Rectangle, material: Material, z: float) -> None:
    center = ((area.x0 + area.x1) / 2, (area.y0 + area.y1) / 2, z)
    item.box(material, center, (area.x1 - area.x0, area.y1 - area.y0, _THICK))


def add_walls(room: Room) -> Material:
    """Add every wall as an item: plain, with a coloured lower part, or with a skirting board.

    Returns:
        The material that most walls share.
    """
    color = room.palette.color() if room.chance(0.3) else room.palette.pale()
    patterns = (Pattern.PLAIN, Pattern.PLAIN, Pattern.SPECKLE, Pattern.STRIPES, Pattern.TILES)
    common = room.palette.material(*patterns, color=color)
    design = room.pick((0.5, 0.2, 0.3))
    accent = room.palette.material()
    height = room.plan.height
    for wall in room.plan.walls:
        material = common if room.chance(0.8) else room.palette.material(*patterns)
        item = room.item("wall", wall.frame)
        middle = wall.length / 2
        item.box(material, (middle, -_THICK / 2, height / 2), (wall.length, _THICK, height))
        if design == 1:
            item.box(accent, (middle, 0.002, 0.5), (wall.length, 0.004, 1.0))
        elif design == 2:
            item.box(accent.shaded(1.0), (middle, 0.005, 0.05), (wall.length, 0.01, 0.1))
    return common


def add_column(room: Room) -> None:
    """Add a column, in the open or at a wall: round, square or six-sided, maybe with a base."""
    size = room.rng.uniform(0.34, 0.62)
    if room.chance(0.5):
        frame = room.plan.against_wall(room.rng, size + 0.1, size * 0.9, "full")
        frame = frame and frame.at(0, size * 0.4)
    else:
        frame = room.plan.in_the_open(room.rng, size + 0.1, size + 0.1)
    if frame is None:
        return
    column = room.item("column", frame)
    add = (column.box, column.cylinder, column.prism)[room.pick((0.45, 0.4, 0.15))]
    material = room.palette.material()
    height = room.plan.height
    add(material, (0, 0, height / 2), (size, size, height))
    if room.chance(0.4):
        trim = material.shaded(room.rng.uniform(0.6, 1.3))
        wide = size + 0.1
        add(trim, (0, 0, 0.1), (wide, wide, 0.2))
        add(trim, (0, 0, height - 0.1), (wide, wide, 0.2))


def add_beams(room: Room) -> None:
    """Add two to four parallel beams under the ceiling: plain, I-shaped or round timber."""
    rng, plan = room.rng, room.plan
    number = room.count(2, 4)
    along_x = room.chance(0.5)
    design = room.pick((0.6, 0.25, 0.15))
    wide, high = rng.uniform(0.22, 0.42), rng.uniform(0.22, 0.42)
    material = room.palette.material()
    across = plan.depth if along_x else plan.width
    for k in range(number):
        place = across * (k + rng.uniform(0.35, 0.65)) / number
        length = _clear_length(room, place, wide, along_x)
        frame = Frame(0, place) if along_x else Frame(place, 0, yaw=np.pi / 2)
        beam = room.item("beam", frame)
        middle, top = length / 2, plan.height
        if design == 0:
            beam.box(material, (middle, 0, top - high / 2), (length, wide, high))
        elif design == 1:
            flange = 0.05
            beam.box(material, (middle, 0, top - flange / 2), (length, wide, flange))
            beam.box(material, (middle, 0, top - high / 2), (length, wide * 0.35, high))
            beam.box(material, (middle, 0, top - high + flange / 2), (length, wide, flange))
        else:
            for drop, share in ((0.35, 1.0), (0.75, 0.7)):
                beam.box(
                    material, (middle, 0, top - high * drop), (length, wide * share, high * 0.7)
                )


def _clear_length(room: Room, place: float, wide: float, along_x: bool) -> float:
    """Metres from the wall at 0 to the wall opposite, where a beam would run."""
    plan = room.plan
    if plan.notch is None:
        return plan.width if along_x else plan.depth
    if along_x:
        return plan.notch.x0 if place + wide / 2 > plan.notch.y0 else plan.width
    return plan.notch.y0 if place + wide / 2 > plan.notch.x0 else plan.depth
