"""Room types, and their furniture: chairs, sofas, tables, boards, bookcases and clutter.

In a frame against a wall x runs along the wall and y into the room; free-standing furniture has its
back at +y. Items that do not fit raise `NoPlaceError`. Parts are in
``tables/synthrooms_parts.csv``.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from datamodules.stanford2d3ds.files import UNKNOWN_CLASS
from datamodules.synthrooms import structure
from datamodules.synthrooms.room import FloorPlan, Frame, Item, NoPlaceError, Rectangle, Room
from datamodules.tables import read_table

_UNLABELED = 0.12  # share of clutter
_BOARD = 0.035  # thickness of the boards of a bookcase in meters
_HEIGHTS = (2.5, 3.3)
_L_SHAPED = 0.35


def _build_chair(room: Room, place: Frame) -> None:
    """Build a chair: four legs, star base, sledge, or tub; with or without armrests."""
    chair = room.item("chair", place)
    design = room.pick(0.35, 0.3, 0.15, 0.2)
    cover, frame = room.palette.material(), room.palette.material("plain", "wood")
    limits = {"wide": (0.44, 0.56), "seat": (0.42, 0.5), "back": (0.4, 0.6), "thick": (0.05, 0.11)}
    sizes = dict(zip(limits, room.sizes(*limits.values()), strict=True))
    if design == 3:
        chair.put("tub chair", cover=cover, **sizes)
        return
    base = ("chair legs", "chair star", "chair sledge")[design]
    gap = room.rng.uniform(0, 0.12)
    chair.put("chair", base, "chair posts", cover=cover, frame=frame, gap=gap, **sizes)
    if room.chance(0.4):
        chair.put("chair arms")


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
    wide, deep = room.sizes((1.5, 2.4), (0.8, 1.0))
    reach = deep + (0.7 if design == 3 else 0.0)
    try:
        frame = room.plan.against_wall(rng, wide, reach, "low").at(0, deep / 2 + 0.03, yaw=np.pi)
    except NoPlaceError:
        design = 0 if design == 3 else design
        frame = room.plan.in_the_open(rng, wide, deep)
        frame = frame.at(0, 0, yaw=np.pi * room.count(0, 1))
    sofa = room.item("sofa", frame)
    cover = material("plain", "speckle", "stripes")
    cushion = cover if room.chance(0.6) else material("plain", "speckle")
    seat = rng.uniform(0.36, 0.46)
    sofa.put("sofa", cover=cover, cushion=cushion, wide=wide, deep=deep, seat=seat)
    if design == 3:
        sofa.put("sofa corner")
    sofa.put("sofa back", back=rng.uniform(0.4, 0.52))
    arm = 0.0 if design == 1 else rng.uniform(0.14, 0.24)
    keys = ("sofa round arm", "sofa arm") if design == 2 else ("sofa arm",)
    for side in ((-1, 1), (), (-1, 1), (-1,))[design]:
        sofa.put(*keys, arm=arm, x=side * (wide / 2 - arm / 2))
    seats = max(1, round((wide - 2 * arm) / 0.7))
    pitch = (wide - 2 * arm) / seats
    for k in range(seats):
        sofa.put("sofa seat", pitch=pitch, x=(k + 0.5 - seats / 2) * pitch)
        if room.chance(0.7):
            sofa.put("sofa cushion")


def add_table(room: Room) -> None:
    """Add a table in the open: four legs, round, panel ends, or a trestle; with chairs around."""
    rng = room.rng
    design = room.pick(0.4, 0.2, 0.25, 0.15)
    wide, deep = room.sizes((1.2, 2.4), (0.75, 1.2))
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
    wide, deep = room.sizes((1.2, 1.9), (0.65, 0.85))
    frame = room.plan.against_wall(rng, wide, deep, "low")
    _build_table(room, frame.at(0, deep / 2 + 0.02), 0 if room.chance(0.5) else 2, wide, deep)
    if room.chance(0.8):
        heading = rng.normal(0, 0.4)
        _add_chair_at(room, frame.at(rng.uniform(-0.2, 0.2), deep + 0.33, yaw=heading))


def _build_table(room: Room, frame: Frame, design: int, wide: float, deep: float) -> None:
    """Build one of the designs of `add_table`, with up to four items of clutter on it."""
    rng, material = room.rng, room.palette.material
    high = rng.uniform(0.68, 0.78)
    table = room.item("table", frame)
    top = material()
    base = material() if room.chance(0.5) else top
    key = "round table" if design == 1 else "table top"
    table.put(key, top=top, base=base, wide=wide, deep=deep, high=high)
    if design == 0:
        table.put("table legs", thick=rng.uniform(0.05, 0.1))
    elif design == 2:
        table.put("table panels", drawers=material("plain", "wood"))
    elif design == 3:
        table.put("table trestle")
    number = room.count(0, 4)
    for k in range(number):
        x = wide * 0.8 * ((k + 0.5) / number - 0.5)
        y = deep * rng.uniform(-0.2, 0.2)
        place = frame.at(x, y, high + 0.025, yaw=rng.normal(0, 0.4))
        _build_desk_item(room, _add_clutter(room, place))


def _add_clutter(room: Room, frame: Frame) -> Item:
    return room.item(UNKNOWN_CLASS if room.chance(_UNLABELED) else "clutter", frame)


def _build_desk_item(room: Room, item: Item) -> None:
    """Build a monitor, a pile of books, a vase, a box, or a desk lamp."""
    rng, draw = room.rng, room.palette.material
    material = draw()
    kind = room.pick(0.4, 0.2, 0.15, 0.15, 0.1)
    if kind == 0:
        wide, high = room.sizes((0.45, 0.65), (0.32, 0.42))
        sizes = {"wide": wide, "high": high, "z": 0.12 + high / 2}
        item.put("monitor", material=material, plastic=draw("plain"), **sizes)
    elif kind == 1:
        for k in range(room.count(3, 6)):
            cover, yaw = draw("plain"), rng.uniform(-0.4, 0.4)
            item.add("box", cover, (0, 0, 0.025 + 0.05 * k), (0.32, 0.24, 0.05), yaw)
    elif kind == 2:
        item.put("vase", material=material, flowers=draw("speckle"))
    elif kind == 3:
        high, wide, deep = room.sizes((0.18, 0.36), (0.2, 0.42), (0.2, 0.34))
        item.put("carton", material=material, wide=wide, deep=deep, high=high)
    else:
        item.put("desk lamp", material=material, shade=draw("plain"))


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
            item.add("box", draw(), center, (side, side, size * 0.7), yaw)
        return
    material = draw()
    if kind == 1:
        item.put("pot", material=material, size=size)
        leaves = draw("speckle", frequency=(3, 8))
        for z, wide in ((0.6, 0.85), (0.95, 1.0), (1.25, 0.75)):
            x, y = rng.uniform(-0.05, 0.05, 2)
            item.add("ball", leaves, (x, y, z), (size * wide, size * wide, 0.5))
    elif kind == 3:
        item.put("cabinet", high=rng.uniform(0.6, 1.25), material=material, size=size)
    elif kind == 4:
        item.put("standing lamp", shade=draw("plain"), material=material, size=size)
    else:
        item.put("bin" if kind == 2 else "ball", material=material, size=size)


def add_wall_clutter(room: Room) -> None:
    """Hang an item on a wall: a picture, a screen, a wall cupboard, or a clock."""
    rng = room.rng
    wide, high = room.sizes((0.5, 1.3), (0.45, 0.9))
    key = ("picture", "screen", "wall cupboard", "clock")[room.pick(0.4, 0.25, 0.2, 0.15)]
    frame = room.plan.against_wall(rng, wide, 0, "high")
    z = min(rng.uniform(1.45, 1.75), room.plan.height - high / 2 - 0.1)
    item = _add_clutter(room, frame)
    face, trim = room.palette.material(), room.palette.material("plain")
    item.put(key, face=face, trim=trim, wide=wide, high=high, z=z)


def add_board(room: Room) -> None:
    """Add a board: white, black or colored with writing, or a pin board with papers."""
    rng, palette = room.rng, room.palette
    wide, high = room.sizes((1.5, 3.2), (1.05, 1.45))
    bottom = min(rng.uniform(0.75, 0.95), room.plan.height - high - 0.15)
    frame = room.plan.against_wall(rng, wide + 0.1, 0, "high")
    design = room.pick(0.45, 0.2, 0.2, 0.15)
    color = (
        palette.hsv((0, 1), (0, 0.04), (0.85, 1.0)),
        palette.hsv((0.3, 0.5), (0, 0.45), (0.15, 0.35)),
        palette.color(),
        palette.hsv((0.06, 0.12), (0.3, 0.6), (0.5, 0.8)),
    )[design]
    value = (0.8, 1.0) if color.mean() < 0.5 or design == 3 else (0.1, 0.4)
    writing = palette.hsv((0, 1), (0.1, 0.8), value)
    pattern = "papers" if design == 3 else "strokes"
    face = palette.material(pattern, color=color, second=writing, frequency=(2.5, 5))
    sizes = {"wide": wide, "high": high, "bottom": bottom, "middle": bottom + high / 2}
    board = room.item("board", frame)
    board.put("board", face=face, trim=palette.material("plain", "wood"), **sizes)
    if design < 3:
        board.put("board tray")
    if room.chance(0.35):  # a second panel slid aside, common in lecture rooms
        board.put("board panel")


def add_bookcase(room: Room) -> None:
    """Add a bookcase: open, with doors below, a low shelf, or a metal rack."""
    rng = room.rng
    design = room.pick(0.45, 0.25, 0.15, 0.15)
    wide, deep = room.sizes((1.0, 2.4), (0.3, 0.45))
    high = rng.uniform(1.0, 1.3) if design == 2 else rng.uniform(1.7, 2.3)
    high = min(high, room.plan.height - 0.3)
    case = room.item("bookcase", room.plan.against_wall(rng, wide, deep, "full"))
    columns = 1 + int(wide > 1.3) + int(wide > 2.0)
    bottom = high * 0.35 if design == 1 else 0.04
    sizes = {"wide": wide, "deep": deep, "high": high, "bottom": bottom}
    key = "bookcase posts" if design == 3 else "bookcase back"
    case.put(key, body=room.palette.material(), **sizes)
    for k in range(columns + 1 if design < 3 else 0):
        case.put("bookcase side", x=(wide - _BOARD) * (k / columns - 0.5))
    if design == 1:
        front = room.palette.material("plain", "wood")
        for k in range(columns):
            x = wide * ((k + 0.5) / columns - 0.5)
            case.put("cupboard door", front=front, x=x, door=wide / columns)
    shelves = max(2, round((high - bottom) / rng.uniform(0.32, 0.42)))
    pitch = (high - bottom - _BOARD) / shelves
    for k in range(shelves + 1):
        case.put("bookcase shelf", z=bottom + _BOARD / 2 + k * pitch)
    size = (wide / columns - 2 * _BOARD, deep, pitch - _BOARD)
    for k in range(shelves):
        for column in range(columns):
            if room.chance(0.85):
                start = wide * (column / columns - 0.5) + _BOARD
                _add_row(room, case, start, bottom + _BOARD + k * pitch, size)


def _add_row(room: Room, case: Item, x: float, z: float, size: tuple[float, float, float]) -> None:
    """Fill a compartment of a bookcase, beginning at x and z, with a box or with books."""
    rng, (wide, deep, space) = room.rng, size
    if room.chance(0.2):
        high = space * rng.uniform(0.5, 0.8)
        center = (x + wide * rng.uniform(0.35, 0.65), deep / 2, z + high / 2)
        case.add("box", room.palette.material(), center, (wide * 0.55, deep * 0.7, high))
        return
    books = room.palette.material("books", frequency=(14, 28))
    place, end = x, x + wide
    while place < x + wide * 0.55:
        stretch = min(wide * rng.uniform(0.3, 0.6), end - place)
        high = space * rng.uniform(0.6, 0.95)
        center = (place + stretch / 2, deep * 0.45, z + high / 2)
        case.add("box", books, center, (stretch, deep * rng.uniform(0.55, 0.8), high))
        place += stretch


_TYPES = {row["type"]: row for row in read_table("synthrooms_types")}
"""Room types of Stanford2D3DS: share of rooms, and limits of the sides in meters."""

_PROGRAM = (
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
    room = Room(rng, plan)
    structure.add_shell(room)
    return room


def build_room(rng: np.random.Generator, room_type: str) -> Room:
    """Build a furnished room.

    Args:
        rng: The room's source of randomness.
        room_type: From `draw_room_type`.
    """
    limits = [_TYPES[room_type][side].split() for side in ("long", "short")]
    long, short = (rng.uniform(float(a), float(b)) for a, b in limits)
    size, notch = (long, short, rng.uniform(*_HEIGHTS)), None
    if rng.random() < _L_SHAPED and short >= 3.2:
        notch = (long * rng.uniform(0.25, 0.5), short * rng.uniform(0.25, 0.45))
    room = build_empty_room(rng, FloorPlan(size, notch))
    for add, share, least, most in _PROGRAM:
        if room.chance(share):
            for _ in range(room.count(least, most)):
                with suppress(NoPlaceError):
                    add(room)
    return room
