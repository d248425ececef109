"""Floor, ceiling, walls, columns, beams, doors, windows and ceiling lamps.

In a frame against a wall x runs along the wall and y into the room. Items that do not fit raise
`NoPlaceError`.
"""

from __future__ import annotations

import math

import numpy as np

from datamodules.synthrooms.materials import Material
from datamodules.synthrooms.room import Frame, Item, Light, Room, Zone

_THICK = 0.1
_SKY = ((0.5, 0.65), (0.05, 0.4), (0.8, 1.0))
_LIT_SIDE = 0.16  # meters in front of the glass, past frame and sill


def add_shell(room: Room) -> None:
    """Add the floor, sometimes with a carpet; the ceiling, plain, tiled or boarded; and walls."""
    plan, palette = room.plan, room.palette
    floor = palette.material("wood", "tiles", "speckle", "plain", "stripes", frequency=(1, 4))
    item = _add_slabs(room, "floor", floor, -_THICK / 2)
    if room.chance(0.3):
        carpet = palette.material("speckle", "stripes", "plain")
        x, y = plan.width * 0.4, plan.depth * 0.4
        item.add("box", carpet, (x, y, 0.006), (plan.width * 0.45, y, 0.012))
    color = palette.color() if room.chance(0.2) else palette.pale()
    patterns = ("plain", "plain", "tiles", "speckle", "stripes")
    ceiling = palette.material(*patterns, color=color, frequency=(1, 2.5))
    _add_slabs(room, "ceiling", ceiling, plan.height + _THICK / 2)
    materials = (floor, ceiling, _add_walls(room))
    room.reflectance = np.mean([material.color**2 for material in materials], axis=0)


def _add_slabs(room: Room, name: str, material: Material, z: float) -> Item:
    item = room.item(name, Frame(0, 0))
    for x0, y0, x1, y1 in room.plan.floors:
        item.add("box", material, ((x0 + x1) / 2, (y0 + y1) / 2, z), (x1 - x0, y1 - y0, _THICK))
    return item


def _add_walls(room: Room) -> Material:
    """Add the walls: plain, with a colored lower part, or with a skirting board.

    Returns:
        The material that most walls share.
    """
    palette = room.palette
    color = palette.color() if room.chance(0.3) else palette.pale()
    patterns = ("plain", "plain", "speckle", "stripes", "tiles")
    common = palette.material(*patterns, color=color)
    keys = (("wall",), ("wall", "wall wainscot"), ("wall", "wall skirting"))[room.pick(5, 2, 3)]
    accent = palette.material()
    for wall in room.plan.walls:
        material = common if room.chance(0.8) else palette.material(*patterns)
        sizes = {"length": wall.length, "height": room.plan.height}
        room.item("wall", wall.frame).put(*keys, material=material, accent=accent, **sizes)
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
    design = ("beam plain", "beam flanged", "beam timber")[room.pick(0.6, 0.25, 0.15)]
    wide, high = room.sizes((0.22, 0.42), (0.22, 0.42))
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
        room.item("beam", frame).put(design, material=material, **sizes)


def add_door(room: Room) -> None:
    """Add a door: plain, panelled, glazed or with two leaves, in a frame, with a handle."""
    rng, material = room.rng, room.palette.material
    design = room.pick(0.3, 0.3, 0.2, 0.2)
    wide = rng.uniform(1.4, 1.9) if design == 3 else rng.uniform(0.85, 1.15)
    top = min(room.plan.height - 0.2, rng.uniform(2.0, 2.3))
    door = room.item("door", room.plan.against_wall(rng, wide + 0.15, 0.85, "full"))
    leaf, trim = (material("plain", "wood") for _ in range(2))
    sizes = {"wide": wide, "top": top, "middle": top / 2, "high": top}
    door.put("door", "opening", leaf=leaf, trim=trim, **sizes)
    if design == 1:
        door.put("door inset", inset=leaf.shaded(rng.uniform(0.6, 0.85)))
    elif design == 2:
        door.put("door pane", glass=material("plain", color=room.palette.hsv(*_SKY)))
    elif design == 3:
        door.put("door gap")
    door.put("door handle", side=0.08 if design == 3 else wide * 0.4)


def add_window(room: Room) -> None:
    """Add a window: outside light or frosted glass, one to four panes, a sill, maybe a blind."""
    rng = room.rng
    tall = room.chance(0.25)
    wide = rng.uniform(1.2, 2.6)
    bottom = rng.uniform(0.1, 0.3) if tall else rng.uniform(0.8, 1.05)
    top = min(room.plan.height - 0.25, bottom + rng.uniform(1.0, 1.5) + (0.7 if tall else 0))
    zone: Zone = "full" if tall else "high"
    frame = room.plan.against_wall(rng, wide + 0.15, 0.25 if tall else 0, zone)
    trim = room.palette.material("plain")
    middle, high = (bottom + top) / 2, top - bottom
    sizes = {"wide": wide, "middle": middle, "high": high, "bottom": bottom, "top": top}
    bright = room.chance(0.75)
    window = room.item("window", frame)
    window.put("window", "opening", "window sill", trim=trim, glass=_glass(room, bright), **sizes)
    panes = room.count(1, 4)
    for k in range(1, panes):
        window.put("window bar", x=wide * (k / panes - 0.5))
    if room.chance(0.4):
        window.put("window transom")
    if room.chance(0.25):
        blind = room.palette.material("plain")
        for z in np.arange(top - 0.04, top - high * rng.uniform(0.2, 0.7), -0.09):
            window.put("window slat", blind=blind, z=float(z))
    if bright:
        center = np.array(frame.at(0, _LIT_SIDE, middle)[:3])
        cos, sin = np.cos(frame.yaw), np.sin(frame.yaw)
        sides = np.array([[cos * wide * 0.4, sin * wide * 0.4, 0], [0, 0, high * 0.4]])
        strength = rng.uniform(0.4, 1.0) * wide * high
        room.lights.append(Light(center, sides, np.array([-sin, cos, 0]), strength))


def _glass(room: Room, bright: bool) -> Material:
    if not bright:
        return room.palette.material("plain", "speckle", frequency=(0.5, 2))
    return room.palette.material(
        "outside",
        color=room.palette.hsv(*_SKY),
        second=room.palette.hsv((0.05, 0.45), (0.05, 0.6), (0.25, 0.7)),
        frequency=(0.5, 1.5),
        emission=room.rng.uniform(0.3, 0.6),
        unscanned=room.chance(0.25),
    )


def add_lamp(room: Room) -> None:
    """Add a ceiling lamp: a panel, a long tube, a disc, or a hanging ball; it lights the room."""
    rng, plan = room.rng, room.plan
    x0, y0, x1, y1 = plan.floors[rng.integers(len(plan.floors))]
    x, y = (start + (end - start) * rng.uniform(0.3, 0.7) for start, end in ((x0, x1), (y0, y1)))
    if any(math.hypot(x - lamp.center[0], y - lamp.center[1]) < 1.3 for lamp in room.lights):
        return
    design = room.pick(0.35, 0.3, 0.2, 0.15)
    wide, deep = ((0.6, 0.6), (1.4, 0.25), (0.5, 0.5), (0.4, 0.4))[design]
    z = plan.height - (rng.uniform(0.3, 0.6) if design == 3 else 0.07)
    tint = room.palette.hsv((0.08, 0.16), (0, 0.15), (0.95, 1.0))
    glow = room.palette.material("plain", color=tint, emission=rng.uniform(1.0, 1.6))
    lamp = room.item("clutter", Frame(x, y))
    if design == 3:
        cord = room.palette.material("plain")
        lamp.put("hanging lamp", glow=glow, cord=cord, z=z, height=plan.height)
    else:
        shape = "cylinder" if design == 2 else "box"
        lamp.add(shape, glow, (0, 0, z + 0.035), (wide, deep, 0.07))
    sides = np.array([[wide * 0.45, 0, 0], [0, deep * 0.45, 0]])
    center, down = np.array([x, y, z - 0.02]), np.array([0.0, 0.0, -1.0])
    room.lights.append(Light(center, sides, down, rng.uniform(0.7, 1.3)))
