"""Boards and bookcases."""

from __future__ import annotations

from datamodules.synthrooms.palette import Material, Pattern
from datamodules.synthrooms.room import Item, Room

__all__ = ["add_board", "add_bookcase"]

_BOARD = 0.035


def add_board(room: Room) -> None:
    """Add a board: white, black or coloured with writing, or a pin board with papers."""
    rng = room.rng
    wide, high = rng.uniform(1.5, 3.2), rng.uniform(1.05, 1.45)
    bottom = min(rng.uniform(0.75, 0.95), room.plan.height - high - 0.15)
    frame = room.plan.against_wall(rng, wide + 0.1, 0, "high")
    if frame is None:
        return
    design = room.pick((0.45, 0.2, 0.2, 0.15))
    color = (
        room.palette.hsv((0, 1), (0, 0.04), (0.85, 1.0)),
        room.palette.hsv((0.3, 0.5), (0, 0.45), (0.15, 0.35)),
        room.palette.color(),
        room.palette.hsv((0.06, 0.12), (0.3, 0.6), (0.5, 0.8)),
    )[design]
    pattern = Pattern.PAPERS if design == 3 else Pattern.STROKES
    dark = color.mean() < 0.5
    writing = room.palette.hsv(
        (0, 1), (0.1, 0.8), (0.8, 1.0) if dark or design == 3 else (0.1, 0.4)
    )
    face = room.palette.material(pattern, color=color, second=writing, frequency=(2.5, 5))
    trim = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
    board = room.item("board", frame)
    middle = bottom + high / 2
    board.box(face, (0, 0.015, middle), (wide, 0.03, high))
    for side in (-1, 1):
        board.box(trim, (side * wide / 2, 0.02, middle), (0.05, 0.045, high + 0.05))
        board.box(trim, (0, 0.02, middle + side * high / 2), (wide, 0.045, 0.05))
    if design < 3:
        board.box(trim, (0, 0.06, bottom), (wide * 0.7, 0.1, 0.025))
    if room.chance(0.35):  # a second panel slid aside, as in lecture rooms
        board.box(face, (wide * 0.22, 0.04, middle), (wide * 0.5, 0.02, high * 0.9))


def add_bookcase(room: Room) -> None:
    """Add a bookcase: open, with doors below, a low shelf, or a metal rack."""
    rng = room.rng
    design = room.pick((0.45, 0.25, 0.15, 0.15))
    wide, deep = rng.uniform(1.0, 2.4), rng.uniform(0.3, 0.45)
    high = rng.uniform(1.0, 1.3) if design == 2 else rng.uniform(1.7, 2.3)
    high = min(high, room.plan.height - 0.3)
    frame = room.plan.against_wall(rng, wide, deep, "full")
    if frame is None:
        return
    case = room.item("bookcase", frame)
    body = room.palette.material()
    columns = 1 + int(wide > 1.3) + int(wide > 2.0)
    bottom = high * 0.35 if design == 1 else 0.04
    if design == 3:
        for x in (-wide / 2 + 0.03, wide / 2 - 0.03):
            for y in (0.03, deep - 0.03):
                case.box(body, (x, y, high / 2), (0.05, 0.05, high))
    else:
        case.box(body.shaded(0.75), (0, 0.01, high / 2), (wide, 0.02, high))
        for k in range(columns + 1):
            x = (wide - _BOARD) * (k / columns - 0.5)
            case.box(body, (x, deep / 2, high / 2), (_BOARD, deep, high))
    if design == 1:
        _add_cupboard(room, case, body, wide, deep, bottom, columns)
    _add_shelves(room, case, body, (wide, deep, high), bottom, columns)


def _add_cupboard(
    room: Room, case: Item, body: Material, wide: float, deep: float, high: float, doors: int
) -> None:
    front = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
    for k in range(doors):
        x = wide * ((k + 0.5) / doors - 0.5)
        case.box(front, (x, deep / 2, high / 2), (wide / doors - 0.04, deep + 0.03, high - 0.06))
        case.box(body.shaded(0.4), (x, deep + 0.03, high * 0.8), (0.1, 0.02, 0.02))


def _add_shelves(
    room: Room,
    case: Item,
    body: Material,
    size: tuple[float, float, float],
    bottom: float,
    columns: int,
) -> None:
    """Shelves with rows of books or boxes; all of it belongs to the bookcase."""
    wide, deep, high = size
    shelves = max(2, round((high - bottom) / room.rng.uniform(0.32, 0.42)))
    pitch = (high - bottom - _BOARD) / shelves
    for k in range(shelves + 1):
        case.box(body, (0, deep / 2, bottom + _BOARD / 2 + k * pitch), (wide, deep, _BOARD))
    for k in range(shelves):
        for column in range(columns):
            if room.chance(0.85):
                start = wide * (column / columns - 0.5) + _BOARD
                z = bottom + _BOARD + k * pitch
                _add_row(room, case, start, wide / columns - 2 * _BOARD, deep, z, pitch - _BOARD)


def _add_row(
    room: Room, case: Item, start: float, wide: float, deep: float, z: float, room_above: float
) -> None:
    rng = room.rng
    if room.chance(0.2):
        high = room_above * rng.uniform(0.5, 0.8)
        x = start + wide * rng.uniform(0.35, 0.65)
        material = room.palette.material()
        case.box(material, (x, deep / 2, z + high / 2), (wide * 0.55, deep * 0.7, high))
        return
    books = room.palette.material(Pattern.BOOKS, frequency=(14, 28))
    place = start
    while place < start + wide * 0.55:
        stretch = min(wide * rng.uniform(0.3, 0.6), start + wide - place)
        high = room_above * rng.uniform(0.6, 0.95)
        size = (stretch, deep * rng.uniform(0.55, 0.8), high)
        case.box(books, (place + stretch / 2, deep * 0.45, z + high / 2), size)
        place += stretch
