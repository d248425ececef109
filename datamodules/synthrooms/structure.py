"""Floor, ceiling, walls, columns, beams, doors, windows and ceiling lamps.

In a frame against a wall x runs along the wall and y into the room. Items that do not fit raise
`NoPlaceError`.
"""

from __future__ import annotations

import math

import numpy as np

from datamodules.synthrooms.layout import Frame, Zone
from datamodules.synthrooms.materials import Material, Pattern
from datamodules.synthrooms.room import Light, Room, RoomItem

_THICK = 0.1
_SKY = ((0.5, 0.65), (0.05, 0.4), (0.8, 1.0))
_LIT_SIDE = 0.16  # meters in front of the glass, past frame and sill


def add_shell(room: Room) -> None:
    """Add floor, ceiling and walls."""
    materials = [add(room) for add in (_add_floor, _add_ceiling, _add_walls)]
    room.reflectance = np.mean([material.color**2 for material in materials], axis=0)


def _add_slabs(room: Room, name: str, material: Material, z: float) -> RoomItem:
    item = room.item(name, Frame(0, 0))
    for area in room.plan.floors:
        center = ((area.x0 + area.x1) / 2, (area.y0 + area.y1) / 2, z)
        item.box(material, center, (area.x1 - area.x0, area.y1 - area.y0, _THICK))
    return item


def _add_floor(room: Room) -> Material:
    """Add the floor, sometimes with a carpet; return its main material."""
    patterns = (Pattern.WOOD, Pattern.TILES, Pattern.SPECKLE, Pattern.PLAIN, Pattern.STRIPES)
    material = room.palette.material(*patterns, frequency=(1, 4))
    floor = _add_slabs(room, "floor", material, -_THICK / 2)
    if room.chance(0.3):
        carpet = room.palette.material(Pattern.SPECKLE, Pattern.STRIPES, Pattern.PLAIN)
        x, y = room.plan.width * 0.4, room.plan.depth * 0.4
        floor.box(carpet, (x, y, 0.006), (room.plan.width * 0.45, room.plan.depth * 0.4, 0.012))
    return material


def _add_ceiling(room: Room) -> Material:
    """Add the ceiling: plain, tiled or boarded; return its material."""
    color = room.palette.color() if room.chance(0.2) else room.palette.pale()
    patterns = (Pattern.PLAIN, Pattern.PLAIN, Pattern.TILES, Pattern.SPECKLE, Pattern.STRIPES)
    material = room.palette.material(*patterns, color=color, frequency=(1, 2.5))
    _add_slabs(room, "ceiling", material, room.plan.height + _THICK / 2)
    return material


def _add_walls(room: Room) -> Material:
    """Add the walls: plain, with a colored lower part, or with a skirting board.

    Returns:
        The material that most walls share.
    """
    color = room.palette.color() if room.chance(0.3) else room.palette.pale()
    patterns = (Pattern.PLAIN, Pattern.PLAIN, Pattern.SPECKLE, Pattern.STRIPES, Pattern.TILES)
    common = room.palette.material(*patterns, color=color)
    design = room.pick(0.5, 0.2, 0.3)
    accent = room.palette.material()
    for wall in room.plan.walls:
        material = common if room.chance(0.8) else room.palette.material(*patterns)
        item = room.item("wall", wall.frame)
        item.put("wall", material=material, length=wall.length, height=room.plan.height)
        if design:
            key = ("wall wainscot", "wall skirting")[design - 1]
            item.put(key, accent=accent, length=wall.length)
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
    shape = ("box", "cylinder", "prism")[room.pick(0.45, 0.4, 0.15)]
    material = room.palette.material()
    height = room.plan.height
    column.add(shape, material, (0, 0, height / 2), (size, size, height))
    if room.chance(0.4):
        trim = material.shaded(room.rng.uniform(0.6, 1.3))
        for z in (0.1, height - 0.1):
            column.add(shape, trim, (0, 0, z), (size + 0.1, size + 0.1, 0.2))


def add_beams(room: Room) -> None:
    """Add two to four parallel beams under the ceiling: plain, I-shaped or round timber."""
    rng, plan = room.rng, room.plan
    number = room.count(2, 4)
    along_x = room.chance(0.5)
    design = ("plain", "flanged", "timber")[room.pick(0.6, 0.25, 0.15)]
    wide, high = rng.uniform(0.22, 0.42), rng.uniform(0.22, 0.42)
    material = room.palette.material()
    across, whole = (plan.depth, plan.width) if along_x else (plan.width, plan.depth)
    for k in range(number):
        place = across * (k + rng.uniform(0.35, 0.65)) / number
        length = whole
        if plan.notch is not None:  # a beam ends at the wall of the missing corner
            start, end = plan.notch[1::-1] if along_x else plan.notch[:2]
            length = end if place + wide / 2 > start else whole
        frame = Frame(0, place) if along_x else Frame(place, 0, yaw=np.pi / 2)
        sizes = {"length": length, "wide": wide, "high": high, "top": plan.height}
        room.item("beam", frame).put(f"beam {design}", material=material, **sizes)


def add_door(room: Room) -> None:
    """Add a door: plain, panelled, glazed or with two leaves, in a frame, with a handle."""
    rng, material = room.rng, room.palette.material
    design = room.pick(0.3, 0.3, 0.2, 0.2)
    wide = rng.uniform(1.4, 1.9) if design == 3 else rng.uniform(0.85, 1.15)
    top = min(room.plan.height - 0.2, rng.uniform(2.0, 2.3))
    door = room.item("door", room.plan.against_wall(rng, wide + 0.15, 0.85, "full"))
    leaf, trim = (material(Pattern.PLAIN, Pattern.WOOD) for _ in range(2))
    door.put("door", leaf=leaf, wide=wide, top=top)
    door.put("opening", trim=trim, wide=wide, middle=top / 2, high=top, top=top)
    if design == 1:
        inset = leaf.shaded(rng.uniform(0.6, 0.85))
        door.put("door inset", inset=inset, wide=wide, top=top)
    elif design == 2:
        glass = material(Pattern.PLAIN, color=room.palette.hsv(*_SKY))
        door.put("door pane", glass=glass, wide=wide, top=top)
    elif design == 3:
        door.put("door gap", leaf=leaf, top=top)
    door.put("door handle", trim=trim, side=0.08 if design == 3 else wide * 0.4)


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
    sizes = {"trim": trim, "wide": wide, "middle": middle, "high": high, "bottom": bottom}
    bright = room.chance(0.75)
    window.put("window", glass=_glass(room, bright), **sizes)
    window.put("opening", top=top, **sizes)
    window.put("window sill", **sizes)
    panes = room.count(1, 4)
    for k in range(1, panes):
        window.put("window bar", x=wide * (k / panes - 0.5), **sizes)
    if room.chance(0.4):
        window.put("window transom", **sizes)
    if room.chance(0.25):
        blind = room.palette.material(Pattern.PLAIN)
        for z in np.arange(top - 0.04, top - high * rng.uniform(0.2, 0.7), -0.09):
            window.put("window slat", blind=blind, z=float(z), wide=wide)
    if bright:
        _add_daylight(room, frame, middle, wide, high)


def _glass(room: Room, bright: bool) -> Material:
    if not bright:
        return room.palette.material(Pattern.PLAIN, Pattern.SPECKLE, frequency=(0.5, 2))
    return room.palette.material(
        Pattern.OUTSIDE,
        color=room.palette.hsv(*_SKY),
        second=room.palette.hsv((0.05, 0.45), (0.05, 0.6), (0.25, 0.7)),
        frequency=(0.5, 1.5),
        emission=room.rng.uniform(0.3, 0.6),
        unscanned=room.chance(0.25),
    )


def _add_daylight(room: Room, frame: Frame, middle: float, wide: float, high: float) -> None:
    """Add a lamp of the window's size."""
    center = np.array(frame.at(0, _LIT_SIDE, middle)[:3])
    along = np.array([np.cos(frame.yaw), np.sin(frame.yaw), 0.0])
    inward = np.array([-np.sin(frame.yaw), np.cos(frame.yaw), 0.0])
    sides = np.stack([along * wide * 0.4, [0, 0, high * 0.4]])
    room.lights.append(Light(center, sides, inward, room.rng.uniform(0.4, 1.0) * wide * high))


def add_lamp(room: Room) -> None:
    """Add a ceiling lamp: a panel, a long tube, a disc, or a hanging ball; it lights the room."""
    rng, plan = room.rng, room.plan
    area = plan.floors[rng.integers(len(plan.floors))]
    x = area.x0 + (area.x1 - area.x0) * rng.uniform(0.3, 0.7)
    y = area.y0 + (area.y1 - area.y0) * rng.uniform(0.3, 0.7)
    if any(math.hypot(x - lamp.center[0], y - lamp.center[1]) < 1.3 for lamp in room.lights):
        return
    design = room.pick(0.35, 0.3, 0.2, 0.15)
    size = ((0.6, 0.6), (1.4, 0.25), (0.5, 0.5), (0.4, 0.4))[design]
    z = plan.height - (rng.uniform(0.3, 0.6) if design == 3 else 0.07)
    tint = room.palette.hsv((0.08, 0.16), (0, 0.15), (0.95, 1.0))
    glow = room.palette.material(Pattern.PLAIN, color=tint, emission=rng.uniform(1.0, 1.6))
    lamp = room.item("clutter", Frame(x, y))
    if design == 3:
        cord = room.palette.material(Pattern.PLAIN)
        lamp.put("hanging lamp", glow=glow, cord=cord, z=z, height=plan.height)
    else:
        shape = "cylinder" if design == 2 else "box"
        lamp.add(shape, glow, (0, 0, z + 0.035), (*size, 0.07))
    sides = np.array([[size[0] * 0.45, 0, 0], [0, size[1] * 0.45, 0]])
    center, down = np.array([x, y, z - 0.02]), np.array([0.0, 0.0, -1.0])
    room.lights.append(Light(center, sides, down, rng.uniform(0.7, 1.3)))
