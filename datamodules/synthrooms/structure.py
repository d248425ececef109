"""Floor, ceiling, walls, columns, beams, doors and windows.

In a frame against a wall x runs along the wall and y into the room; free-standing furniture has its
back at +y. Items that do not fit raise `NoPlaceError`.
"""

from __future__ import annotations

import numpy as np

from datamodules.synthrooms.layout import Frame, Rectangle, Zone
from datamodules.synthrooms.materials import Material, Pattern
from datamodules.synthrooms.room import Light, Room, RoomItem

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


def _add_slab(item: RoomItem, area: Rectangle, material: Material, z: float) -> None:
    center = ((area.x0 + area.x1) / 2, (area.y0 + area.y1) / 2, z)
    item.box(material, center, (area.x1 - area.x0, area.y1 - area.y0, _THICK))


def add_walls(room: Room) -> Material:
    """Add every wall as an item: plain, with a colored lower part, or with a skirting board.

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
        frame = frame.at(0, size * 0.4)
    else:
        frame = room.plan.in_the_open(room.rng, size + 0.1, size + 0.1)
    column = room.item("column", frame)
    shape = ("box", "cylinder", "prism")[room.pick((0.45, 0.4, 0.15))]
    material = room.palette.material()
    height = room.plan.height
    column.add(shape, material, (0, 0, height / 2), (size, size, height))
    if room.chance(0.4):
        trim = material.shaded(room.rng.uniform(0.6, 1.3))
        wide = size + 0.1
        for z in (0.1, height - 0.1):
            column.add(shape, trim, (0, 0, z), (wide, wide, 0.2))


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
            for z, share in ((top - high * 0.35, 1.0), (top - high * 0.75, 0.7)):
                beam.box(material, (middle, 0, z), (length, wide * share, high * 0.7))


def _clear_length(room: Room, place: float, wide: float, along_x: bool) -> float:
    """Return the meters from the wall at 0 to the opposite wall, where a beam would run."""
    plan = room.plan
    if plan.notch is None:
        return plan.width if along_x else plan.depth
    if along_x:
        return plan.notch.x0 if place + wide / 2 > plan.notch.y0 else plan.width
    return plan.notch.y0 if place + wide / 2 > plan.notch.x0 else plan.depth


_SKY = ((0.5, 0.65), (0.05, 0.4), (0.8, 1.0))
_LIT_SIDE = 0.16  # meters in front of the glass, past frame and sill


def _add_frame(item: RoomItem, material: Material, wide: float, bottom: float, top: float) -> None:
    """Add two posts and a lintel around an opening."""
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
    zone: Zone = "full" if tall else "high"
    frame = room.plan.against_wall(rng, wide + 0.15, 0.25 if tall else 0, zone)
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


def _add_blind(room: Room, window: RoomItem, wide: float, bottom: float, top: float) -> None:
    material = room.palette.material(Pattern.PLAIN)
    lowest = top - (top - bottom) * room.rng.uniform(0.2, 0.7)
    for z in np.arange(top - 0.04, lowest, -0.09):
        window.box(material, (0, 0.075, float(z)), (wide * 0.97, 0.01, 0.06))


def _shine(room: Room, frame: Frame, middle: float, wide: float, high: float) -> None:
    """Add daylight through the window, a lamp of its size."""
    center = np.array(frame.at(0, _LIT_SIDE, middle)[:3])
    along = np.array([np.cos(frame.yaw), np.sin(frame.yaw), 0.0])
    inward = np.array([-np.sin(frame.yaw), np.cos(frame.yaw), 0.0])
    sides = np.stack([along * wide * 0.4, [0, 0, high * 0.4]])
    room.lights.append(Light(center, sides, inward, room.rng.uniform(0.4, 1.0) * wide * high))
