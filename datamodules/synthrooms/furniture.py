"""Chairs, sofas, tables, boards and bookcases.

In a frame against a wall x runs along the wall and y into the room; free-standing furniture has its
back at +y. Items that do not fit raise `NoPlaceError`.
"""

from __future__ import annotations

import numpy as np

from datamodules.synthrooms.clutter import add_desk_things
from datamodules.synthrooms.layout import Frame, NoPlaceError, Rectangle
from datamodules.synthrooms.materials import Material, Pattern
from datamodules.synthrooms.room import Room, RoomItem


def add_chair(room: Room) -> None:
    """Add a chair in the open with a random heading."""
    frame = room.plan.in_the_open(room.rng, 0.6, 0.6)
    _build_chair(room, frame.at(0, 0, yaw=room.rng.uniform(0, 2 * np.pi)))


def add_chair_at(room: Room, frame: Frame) -> None:
    """Add a chair at a place unless it is occupied."""
    area = Rectangle.around(Frame(frame.x, frame.y), (-0.24, 0.24), (-0.24, 0.24))
    if room.plan.claim(area, margin=0.2):
        _build_chair(room, frame)


def _build_chair(room: Room, frame: Frame) -> None:
    """Build a chair: four legs, star base, sledge, or tub; with or without armrests."""
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


def _add_legs(
    item: RoomItem, material: Material, spread: tuple[float, float], height: float, thick: float
) -> None:
    """Add four upright legs from the floor, ``±spread`` meters from the middle."""
    for x in (-spread[0], spread[0]):
        for y in (-spread[1], spread[1]):
            item.box(material, (x, y, height / 2), (thick, thick, height))


def _add_base(chair: RoomItem, material: Material, design: int, wide: float, seat: float) -> None:
    spread = wide / 2 - 0.03
    if design == 0:
        _add_legs(chair, material, (spread, spread), seat, 0.045)
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
    try:
        frame = room.plan.against_wall(rng, wide, reach, "low").at(0, deep / 2 + 0.03, yaw=np.pi)
    except NoPlaceError:
        design = 0 if design == 3 else design
        frame = room.plan.in_the_open(rng, wide, deep)
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
    room: Room, sofa: RoomItem, cover: Material, design: int, size: tuple[float, float, float]
) -> float:
    """Add the arms of a sofa; returns the width of one."""
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


def add_table(room: Room) -> None:
    """Add a table in the open: four legs, round, panel ends, or a trestle; with chairs around."""
    rng = room.rng
    design = room.pick((0.4, 0.2, 0.25, 0.15))
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
                add_chair_at(room, frame.at(float(x), away, yaw=heading))


def add_desk(room: Room) -> None:
    """Add a desk against a wall with a chair in front of it."""
    rng = room.rng
    wide, deep = rng.uniform(1.2, 1.9), rng.uniform(0.65, 0.85)
    frame = room.plan.against_wall(rng, wide, deep, "low")
    _build_table(room, frame.at(0, deep / 2 + 0.02), 0 if room.chance(0.5) else 2, wide, deep)
    if room.chance(0.8):
        heading = rng.normal(0, 0.4)
        add_chair_at(room, frame.at(rng.uniform(-0.2, 0.2), deep + 0.33, yaw=heading))


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
        _add_legs(table, base, (wide / 2 - 0.06, deep / 2 - 0.06), high, thick)
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


_BOARD = 0.035


def add_board(room: Room) -> None:
    """Add a board: white, black or colored with writing, or a pin board with papers."""
    rng = room.rng
    wide, high = rng.uniform(1.5, 3.2), rng.uniform(1.05, 1.45)
    bottom = min(rng.uniform(0.75, 0.95), room.plan.height - high - 0.15)
    frame = room.plan.against_wall(rng, wide + 0.1, 0, "high")
    design = room.pick((0.45, 0.2, 0.2, 0.15))
    color = (
        room.palette.hsv((0, 1), (0, 0.04), (0.85, 1.0)),
        room.palette.hsv((0.3, 0.5), (0, 0.45), (0.15, 0.35)),
        room.palette.color(),
        room.palette.hsv((0.06, 0.12), (0.3, 0.6), (0.5, 0.8)),
    )[design]
    pattern = Pattern.PAPERS if design == 3 else Pattern.STROKES
    dark = color.mean() < 0.5
    value = (0.8, 1.0) if dark or design == 3 else (0.1, 0.4)
    writing = room.palette.hsv((0, 1), (0.1, 0.8), value)
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
    room: Room, case: RoomItem, body: Material, wide: float, deep: float, high: float, doors: int
) -> None:
    front = room.palette.material(Pattern.PLAIN, Pattern.WOOD)
    for k in range(doors):
        x = wide * ((k + 0.5) / doors - 0.5)
        case.box(front, (x, deep / 2, high / 2), (wide / doors - 0.04, deep + 0.03, high - 0.06))
        case.box(body.shaded(0.4), (x, deep + 0.03, high * 0.8), (0.1, 0.02, 0.02))


def _add_shelves(
    room: Room,
    case: RoomItem,
    body: Material,
    size: tuple[float, float, float],
    bottom: float,
    columns: int,
) -> None:
    """Add shelves with rows of books or boxes, which belong to the bookcase."""
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
    room: Room, case: RoomItem, start: float, wide: float, deep: float, z: float, room_above: float
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
