"""Room types, and their furniture: chairs, sofas, tables, boards, bookcases and clutter.

In a frame against a wall x runs along the wall and y into the room; free-standing furniture has its
back at +y. Items that do not fit raise `NoPlaceError`. Parts are in
``tables/synthrooms_parts.csv``.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from datamodules.stanford2d3ds.files import UNKNOWN_CLASS
from datamodules.synthrooms import structure
from datamodules.synthrooms.layout import FloorPlan, Frame, NoPlaceError, Rectangle
from datamodules.synthrooms.materials import Palette, Pattern
from datamodules.synthrooms.room import Room, RoomItem
from datamodules.tables import read_table

_UNLABELED = 0.12  # share of clutter
_BOARD = 0.035  # thickness of the boards of a bookcase in meters
_HEIGHTS = (2.5, 3.3)
_L_SHAPED = 0.35


def _build_chair(room: Room, place: Frame) -> None:
    """Build a chair: four legs, star base, sledge, or tub; with or without armrests."""
    chair = room.item("chair", place)
    design = room.pick(0.35, 0.3, 0.15, 0.2)
    cover, frame = room.palette.material(), room.palette.material(Pattern.PLAIN, Pattern.WOOD)
    values = room.sizes(wide=(0.44, 0.56), seat=(0.42, 0.5), back=(0.4, 0.6), thick=(0.05, 0.11))
    values |= {"cover": cover, "frame": frame}
    if design == 3:
        chair.put("tub chair", **values)
        return
    chair.put("chair", gap=room.rng.uniform(0, 0.12), **values)
    chair.put(("chair legs", "chair star", "chair sledge")[design], **values)
    chair.put("chair posts", **values)
    if room.chance(0.4):
        chair.put("chair arms", **values)


def add_chair(room: Room) -> None:
    """Add a chair in the open with a random heading."""
    frame = room.plan.in_the_open(room.rng, 0.6, 0.6)
    _build_chair(room, frame.at(0, 0, yaw=room.rng.uniform(0, 2 * np.pi)))


def _add_chair_at(room: Room, frame: Frame) -> None:
    """Add a chair at a place unless it is occupied."""
    area = Rectangle.around(Frame(frame.x, frame.y), (-0.24, 0.24), (-0.24, 0.24))
    if room.plan.claim(area, margin=0.2):
        _build_chair(room, frame)


def add_sofa(room: Room) -> None:
    """Add a sofa at a wall or in the open: with arms, a bench, round arms, or around a corner."""
    rng, material = room.rng, room.palette.material
    design = room.pick(0.45, 0.15, 0.2, 0.2)
    wide, deep = rng.uniform(1.5, 2.4), rng.uniform(0.8, 1.0)
    reach = deep + (0.7 if design == 3 else 0.0)
    try:
        frame = room.plan.against_wall(rng, wide, reach, "low").at(0, deep / 2 + 0.03, yaw=np.pi)
    except NoPlaceError:
        design = 0 if design == 3 else design
        frame = room.plan.in_the_open(rng, wide, deep)
        frame = frame.at(0, 0, yaw=np.pi * room.count(0, 1))
    sofa = room.item("sofa", frame)
    cover = material(Pattern.PLAIN, Pattern.SPECKLE, Pattern.STRIPES)
    cushion = cover if room.chance(0.6) else material(Pattern.PLAIN, Pattern.SPECKLE)
    values: dict[str, Any] = {"cover": cover, "cushion": cushion, "wide": wide, "deep": deep}
    values["seat"] = rng.uniform(0.36, 0.46)
    sofa.put("sofa", **values)
    if design == 3:
        sofa.put("sofa corner", **values)
    sofa.put("sofa back", back=rng.uniform(0.4, 0.52), **values)
    arm = 0.0 if design == 1 else rng.uniform(0.14, 0.24)
    for side in ((-1, 1), (), (-1, 1), (-1,))[design]:
        values |= {"arm": arm, "x": side * (wide / 2 - arm / 2)}
        if design == 2:
            sofa.put("sofa round arm", **values)
        sofa.put("sofa arm", **values)
    seats = max(1, round((wide - 2 * arm) / 0.7))
    pitch = (wide - 2 * arm) / seats
    for k in range(seats):
        values |= {"pitch": pitch, "x": (k + 0.5 - seats / 2) * pitch}
        sofa.put("sofa seat", **values)
        if room.chance(0.7):
            sofa.put("sofa cushion", **values)


def add_table(room: Room) -> None:
    """Add a table in the open: four legs, round, panel ends, or a trestle; with chairs around."""
    rng = room.rng
    design = room.pick(0.4, 0.2, 0.25, 0.15)
    wide, deep = rng.uniform(1.2, 2.4), rng.uniform(0.75, 1.2)
    if design == 1:
        wide = deep = rng.uniform(1.0, 1.5)
    rotated = room.chance(0.5)
    footprint = (deep, wide) if rotated else (wide, deep)
    frame = room.plan.in_the_open(rng, *footprint, gap=0.35)
    frame = frame.at(0, 0, yaw=np.pi / 2 if rotated else 0)
    _build_table(room, frame, design, wide, deep)
    seats = 1 + int(wide > 1.6)
    for side in (-1, 1):
        for x in (np.arange(seats) - (seats - 1) / 2) * wide / seats:
            if room.chance(0.7):
                away = side * (deep / 2 + rng.uniform(0.27, 0.4))
                heading = (0 if side > 0 else np.pi) + rng.normal(0, 0.25)
                _add_chair_at(room, frame.at(float(x), away, yaw=heading))


def add_desk(room: Room) -> None:
    """Add a desk against a wall with a chair in front of it."""
    rng = room.rng
    wide, deep = rng.uniform(1.2, 1.9), rng.uniform(0.65, 0.85)
    frame = room.plan.against_wall(rng, wide, deep, "low")
    _build_table(room, frame.at(0, deep / 2 + 0.02), 0 if room.chance(0.5) else 2, wide, deep)
    if room.chance(0.8):
        heading = rng.normal(0, 0.4)
        _add_chair_at(room, frame.at(rng.uniform(-0.2, 0.2), deep + 0.33, yaw=heading))


def _build_table(room: Room, frame: Frame, design: int, wide: float, deep: float) -> None:
    """Build one of the designs of `add_table`, with up to four items of clutter on it."""
    rng, high = room.rng, room.rng.uniform(0.68, 0.78)
    table = room.item("table", frame)
    top = room.palette.material()
    base = room.palette.material() if room.chance(0.5) else top
    values: dict[str, Any] = {"top": top, "base": base, "wide": wide, "deep": deep, "high": high}
    table.put("round table" if design == 1 else "table top", **values)
    if design == 0:
        table.put("table legs", thick=rng.uniform(0.05, 0.1), **values)
    elif design == 2:
        drawers = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
        table.put("table panels", drawers=drawers, **values)
    elif design == 3:
        table.put("table trestle", **values)
    number = room.count(0, 4)
    for k in range(number):
        x = wide * 0.8 * ((k + 0.5) / number - 0.5)
        y = deep * rng.uniform(-0.2, 0.2)
        place = frame.at(x, y, high + 0.025, yaw=rng.normal(0, 0.4))
        _build_desk_item(room, _add_clutter(room, place))


def _add_clutter(room: Room, frame: Frame) -> RoomItem:
    return room.item(UNKNOWN_CLASS if room.chance(_UNLABELED) else "clutter", frame)


def _build_desk_item(room: Room, item: RoomItem) -> None:
    """Build a monitor, a pile of books, a vase, a box, or a desk lamp."""
    rng, draw = room.rng, room.palette.material
    material = draw()
    kind = room.pick(0.4, 0.2, 0.15, 0.15, 0.1)
    if kind == 0:
        wide, high = rng.uniform(0.45, 0.65), rng.uniform(0.32, 0.42)
        values = {"material": material, "plastic": draw(Pattern.PLAIN), "wide": wide, "high": high}
        item.put("monitor", z=0.12 + high / 2, **values)
    elif kind == 1:
        for k in range(room.count(3, 6)):
            cover, yaw = draw(Pattern.PLAIN), rng.uniform(-0.4, 0.4)
            item.box(cover, (0, 0, 0.025 + 0.05 * k), (0.32, 0.24, 0.05), yaw)
    elif kind == 2:
        item.put("vase", material=material, flowers=draw(Pattern.SPECKLE))
    elif kind == 3:
        high, wide, deep = rng.uniform((0.18, 0.2, 0.2), (0.36, 0.42, 0.34))
        item.put("carton", material=material, wide=wide, deep=deep, high=high)
    else:
        item.put("desk lamp", material=material, shade=draw(Pattern.PLAIN))


def add_floor_clutter(room: Room) -> None:
    """Add boxes, a plant, a bin, a cabinet, a standing lamp, or a ball."""
    rng, draw = room.rng, room.palette.material
    size = rng.uniform(0.4, 0.65)
    if room.chance(0.6):
        frame = room.plan.against_wall(rng, size + 0.1, size, "low").at(0, size / 2 + 0.02)
    else:
        frame = room.plan.in_the_open(rng, size, size)
    kind = room.pick(0.25, 0.2, 0.1, 0.25, 0.1, 0.1)
    item = _add_clutter(room, frame)
    if kind == 0:
        for k in range(room.count(1, 3)):
            side, yaw = size * (0.95 - 0.15 * k), rng.normal(0, 0.08)
            center = (0, 0, size * (0.35 + 0.7 * k))
            item.box(draw(), center, (side, side, size * 0.7), yaw)
        return
    values: dict[str, Any] = {"material": draw(), "size": size}
    if kind == 1:
        item.put("pot", **values)
        leaves = draw(Pattern.SPECKLE, frequency=(3, 8))
        for z, wide in ((0.6, 0.85), (0.95, 1.0), (1.25, 0.75)):
            x, y = rng.uniform(-0.05, 0.05, 2)
            item.ball(leaves, (x, y, z), (size * wide, size * wide, 0.5))
    elif kind == 3:
        item.put("cabinet", high=rng.uniform(0.6, 1.25), **values)
    elif kind == 4:
        item.put("standing lamp", shade=draw(Pattern.PLAIN), **values)
    else:
        item.put("bin" if kind == 2 else "ball", **values)


def add_wall_clutter(room: Room) -> None:
    """Hang an item on a wall: a picture, a screen, a wall cupboard, or a clock."""
    rng = room.rng
    wide, high = rng.uniform(0.5, 1.3), rng.uniform(0.45, 0.9)
    key = ("picture", "screen", "wall cupboard", "clock")[room.pick(0.4, 0.25, 0.2, 0.15)]
    frame = room.plan.against_wall(rng, wide, 0, "high")
    z = min(rng.uniform(1.45, 1.75), room.plan.height - high / 2 - 0.1)
    item = _add_clutter(room, frame)
    face, trim = room.palette.material(), room.palette.material(Pattern.PLAIN)
    item.put(key, face=face, trim=trim, wide=wide, high=high, z=z)


def add_board(room: Room) -> None:
    """Add a board: white, black or colored with writing, or a pin board with papers."""
    rng, palette = room.rng, room.palette
    wide, high = rng.uniform(1.5, 3.2), rng.uniform(1.05, 1.45)
    bottom = min(rng.uniform(0.75, 0.95), room.plan.height - high - 0.15)
    frame = room.plan.against_wall(rng, wide + 0.1, 0, "high")
    design = room.pick(0.45, 0.2, 0.2, 0.15)
    color = (
        palette.hsv((0, 1), (0, 0.04), (0.85, 1.0)),
        palette.hsv((0.3, 0.5), (0, 0.45), (0.15, 0.35)),
        palette.color(),
        palette.hsv((0.06, 0.12), (0.3, 0.6), (0.5, 0.8)),
    )[design]
    pattern = Pattern.PAPERS if design == 3 else Pattern.STROKES
    value = (0.8, 1.0) if color.mean() < 0.5 or design == 3 else (0.1, 0.4)
    writing = palette.hsv((0, 1), (0.1, 0.8), value)
    values: dict[str, Any] = {
        "face": palette.material(pattern, color=color, second=writing, frequency=(2.5, 5)),
        "trim": palette.material(Pattern.PLAIN, Pattern.WOOD),
        "wide": wide,
        "high": high,
        "bottom": bottom,
        "middle": bottom + high / 2,
    }
    board = room.item("board", frame)
    board.put("board", **values)
    if design < 3:
        board.put("board tray", **values)
    if room.chance(0.35):  # a second panel slid aside, common in lecture rooms
        board.put("board panel", **values)


def add_bookcase(room: Room) -> None:
    """Add a bookcase: open, with doors below, a low shelf, or a metal rack."""
    rng = room.rng
    design = room.pick(0.45, 0.25, 0.15, 0.15)
    wide, deep = rng.uniform(1.0, 2.4), rng.uniform(0.3, 0.45)
    high = rng.uniform(1.0, 1.3) if design == 2 else rng.uniform(1.7, 2.3)
    high = min(high, room.plan.height - 0.3)
    case = room.item("bookcase", room.plan.against_wall(rng, wide, deep, "full"))
    columns = 1 + int(wide > 1.3) + int(wide > 2.0)
    values: dict[str, Any] = {"body": room.palette.material(), "wide": wide, "deep": deep}
    values |= {"high": high, "bottom": high * 0.35 if design == 1 else 0.04}
    if design == 3:
        case.put("bookcase posts", **values)
    else:
        case.put("bookcase back", **values)
        for k in range(columns + 1):
            case.put("bookcase side", x=(wide - _BOARD) * (k / columns - 0.5), **values)
    if design == 1:
        front = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
        for k in range(columns):
            x = wide * ((k + 0.5) / columns - 0.5)
            case.put("cupboard door", front=front, x=x, door=wide / columns, **values)
    _add_shelves(room, case, values, columns)


def _add_shelves(room: Room, case: RoomItem, values: dict[str, Any], columns: int) -> None:
    """Add shelves with rows of books or boxes, which belong to the bookcase."""
    wide, deep, high, bottom = (values[name] for name in ("wide", "deep", "high", "bottom"))
    shelves = max(2, round((high - bottom) / room.rng.uniform(0.32, 0.42)))
    pitch = (high - bottom - _BOARD) / shelves
    for k in range(shelves + 1):
        case.put("bookcase shelf", z=bottom + _BOARD / 2 + k * pitch, **values)
    for k in range(shelves):
        for column in range(columns):
            if room.chance(0.85):
                start = Frame(
                    wide * (column / columns - 0.5) + _BOARD, 0, bottom + _BOARD + k * pitch
                )
                size = (wide / columns - 2 * _BOARD, deep, pitch - _BOARD)
                _add_row(room, case, start, size)


def _add_row(room: Room, case: RoomItem, start: Frame, size: tuple[float, float, float]) -> None:
    """Fill a compartment of a bookcase with a box or with books."""
    rng, (wide, deep, space) = room.rng, size
    if room.chance(0.2):
        high = space * rng.uniform(0.5, 0.8)
        center = (start.x + wide * rng.uniform(0.35, 0.65), deep / 2, start.z + high / 2)
        case.box(room.palette.material(), center, (wide * 0.55, deep * 0.7, high))
        return
    books = room.palette.material(Pattern.BOOKS, frequency=(14, 28))
    place, end = start.x, start.x + wide
    while place < start.x + wide * 0.55:
        stretch = min(wide * rng.uniform(0.3, 0.6), end - place)
        high = space * rng.uniform(0.6, 0.95)
        center = (place + stretch / 2, deep * 0.45, start.z + high / 2)
        case.box(books, center, (stretch, deep * rng.uniform(0.55, 0.8), high))
        place += stretch


_TYPES = {row["type"]: row for row in read_table("synthrooms_types")}
"""Room types of Stanford2D3DS: share of rooms, and limits of the sides in meters."""

_PROGRAM: tuple[tuple[Callable[[Room], None], float, int, int], ...] = (
    (structure.add_column, 0.75, 1, 2),
    (structure.add_door, 1.0, 1, 2),
    (add_bookcase, 0.85, 1, 2),
    (add_board, 0.9, 1, 2),
    (structure.add_window, 0.95, 1, 2),
    (add_sofa, 0.85, 1, 2),
    (structure.add_beams, 0.75, 1, 1),
    (structure.add_lamp, 1.0, 1, 2),
    (add_table, 0.95, 1, 2),
    (add_desk, 0.75, 1, 2),
    (add_chair, 0.8, 1, 3),
    (add_floor_clutter, 1.0, 2, 5),
    (add_wall_clutter, 0.9, 1, 3),
)
"""Furniture in order of placement: function, share of rooms, smallest and largest number."""


def draw_room_type(rng: np.random.Generator) -> str:
    """Draw a room type of Stanford2D3DS."""
    shares = np.array([float(row["share"]) for row in _TYPES.values()])
    return list(_TYPES)[rng.choice(len(shares), p=shares / shares.sum())]


def build_empty_room(rng: np.random.Generator, plan: FloorPlan) -> Room:
    """Build floor, ceiling and walls."""
    room = Room(rng, plan, Palette(rng))
    structure.add_shell(room)
    return room


def build_room(rng: np.random.Generator, room_type: str) -> Room:
    """Build a furnished room.

    Args:
        rng: The room's source of randomness.
        room_type: From `draw_room_type`.
    """
    limits = [_TYPES[room_type][side].split() for side in ("long", "short")]
    (long, short), notch = (rng.uniform(float(a), float(b)) for a, b in limits), None
    size = (long, short, rng.uniform(*_HEIGHTS))
    if rng.random() < _L_SHAPED and short >= 3.2:
        notch = (long * rng.uniform(0.25, 0.5), short * rng.uniform(0.25, 0.45))
    room = build_empty_room(rng, FloorPlan(size, notch))
    for add, share, least, most in _PROGRAM:
        if room.chance(share):
            for _ in range(room.count(least, most)):
                with suppress(NoPlaceError):
                    add(room)
    return room
