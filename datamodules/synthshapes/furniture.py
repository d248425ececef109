"""Families of furniture; chairs, stools, benches and tables share seats, supports and backs."""

from __future__ import annotations

import math

from datamodules.synthshapes.parts import Parts
from tangent_train.geometry import rotation_about


def chair(parts: Parts) -> None:
    """Build a seat with a back: on legs, a pedestal or solid; perhaps with arms."""
    width, depth = parts.between(0.38, 0.65), parts.between(0.36, 0.6)
    height, thick = parts.between(0.32, 0.55), parts.between(0.02, 0.12)
    inner = _plate(parts, width, depth, height, thick, round_share=0.15)
    _support(parts, *inner, height - thick, pedestal=0.25, solid=0.12)
    _back(parts, width, depth, height, parts.between(0.16, 0.75))
    if parts.chance(0.4):
        rest = height + parts.between(0.14, 0.26)
        for side in (-1, 1):
            y = side * width / 2
            parts.box((0, y, rest), (depth * parts.between(0.6, 1), 0.05, 0.03))
            parts.leg((depth * 0.4, y, rest), (depth * 0.4, y, height - thick), 0.04, square=True)


def stool(parts: Parts) -> None:
    """Build a seat without a back, high or low."""
    width = parts.between(0.26, 0.5)
    depth = width * parts.between(0.75, 1.1)
    height, thick = parts.between(0.35, 0.95), parts.between(0.02, 0.12)
    inner = _plate(parts, width, depth, height, thick, round_share=0.65)
    _support(parts, *inner, height - thick, pedestal=0.4, solid=0.08)
    if parts.chance(0.4):  # for the feet
        at = height * parts.between(0.25, 0.45)
        parts.ring((0, 0, at), min(width, depth) * parts.between(0.35, 0.5), 0.012)
    if parts.chance(0.2):
        _back(parts, width, depth, height, parts.between(0.06, 0.2))


def bench(parts: Parts) -> None:
    """Build a long seat, every other one with a back, some with sides."""
    width, depth = parts.between(0.8, 2.0), parts.between(0.3, 0.6)
    height, thick = parts.between(0.32, 0.55), parts.between(0.03, 0.14)
    if parts.chance(0.4):
        for k in range(4):
            x = (k - 1.5) * depth / 4
            parts.box((x, 0, height - thick / 2), (depth / 4 * 0.7, width, thick / 2))
    else:
        parts.box((0, 0, height - thick / 2), (depth, width, thick))
    _support(parts, width, depth, height - thick, pedestal=0, solid=0.2)
    if parts.chance(0.5):
        _back(parts, width, depth, height, parts.between(0.2, 0.55))
    if parts.chance(0.25):
        for side in (-1, 1):
            parts.box((0, side * width / 2, height * 0.65), (depth, 0.05, height * 1.3))


def table(parts: Parts) -> None:
    """Build a top on legs, a pedestal or boards; low and high, long and round."""
    width = parts.between(0.5, 2.0)
    depth = width * parts.between(0.4, 1.0)
    height, thick = parts.between(0.35, 1.0), parts.between(0.02, 0.08)
    width, depth = _plate(parts, width, depth, height, thick, round_share=0.35)
    _support(parts, width, depth, height - thick, pedestal=0.3, solid=0.06)
    if parts.chance(0.3):
        parts.box((0, 0, height * parts.between(0.2, 0.5)), (depth * 0.85, width * 0.85, 0.02))
    if parts.chance(0.2):  # drawers on one side
        side = width * 0.3
        parts.box((0, (width - side) / 2, height * 0.6), (depth * 0.9, side, height * 0.6))


def lamp(parts: Parts) -> None:
    """Build a shade on a pole with a foot, straight or on an arm; for floor or desk."""
    height = parts.between(0.3, 1.7)
    base = height * parts.between(0.1, 0.24)
    thick = height * parts.between(0.008, 0.03)
    parts.revolved([(0, 0), (base, 0), (base * parts.between(0.5, 1), 0.04), (0, 0.05)])
    shade, low = height * parts.between(0.1, 0.28), height * parts.between(0.12, 0.3)
    x = 0.0
    if parts.chance(0.3):
        x = height * parts.between(0.2, 0.5)
        elbow = height * parts.between(0.4, 0.9)
        parts.rod((0, 0, 0), (-x * 0.3, 0, elbow), thick)
        parts.rod((-x * 0.3, 0, elbow), (x, 0, height), thick)
    else:
        parts.rod((0, 0, 0), (0, 0, height), thick)
        if parts.chance(0.3):
            parts.ellipsoid((0, 0, height * 0.4), [height * parts.between(0.06, 0.15)] * 3)
    if parts.chance(0.2):
        parts.ellipsoid((x, 0, height), (shade, shade, low * 0.7))
    else:
        top = shade * parts.between(0.3, 1.0)
        parts.revolved([(shade, height - low), (top, height)], (x, 0, 0))


def _plate(
    parts: Parts, width: float, depth: float, height: float, thick: float, *, round_share: float
) -> tuple[float, float]:
    """Add a seat or table top, its upper side at `height`; return width and depth below."""
    if not parts.chance(round_share):
        parts.box((0, 0, height - thick / 2), (depth, width, thick))
        return width, depth
    radius = (width + depth) / 4
    low = height - thick
    parts.revolved([(0, low), (radius, low), (radius, height), (0, height)])
    inside = radius * math.sqrt(2) * 0.95  # of a square
    return inside, inside


def _support(
    parts: Parts, width: float, depth: float, height: float, *, pedestal: float, solid: float
) -> None:
    """Add the support of a plate: shares of pedestals and of boards or blocks, else legs."""
    drawn = parts.between(0, 1)
    if drawn < pedestal:
        _pedestal(parts, min(width, depth), height)
    elif drawn < pedestal + solid:
        if parts.chance(0.5):
            parts.box((0, 0, height / 2), (depth * 0.9, width * 0.9, height))
        else:
            for side in (-1, 1):
                y = side * width * parts.between(0.36, 0.48)
                parts.box((0, y, height / 2), (depth * 0.9, 0.04, height))
    else:
        _legs(parts, width, depth, height)


def _pedestal(parts: Parts, size: float, height: float) -> None:
    parts.rod((0, 0, 0.03), (0, 0, height), size * parts.between(0.04, 0.1))
    reach = size * parts.between(0.3, 0.5)
    if parts.chance(0.5):
        parts.revolved([(0, 0), (reach, 0), (reach * 0.8, 0.03), (0, 0.06)])
        return
    count = int(parts.rng.integers(3, 6))
    for k in range(count):
        angle = 2 * math.pi * k / count
        foot = (reach * math.cos(angle), reach * math.sin(angle), 0.02)
        parts.rod((0, 0, 0.08), foot, 0.025)


def _legs(parts: Parts, width: float, depth: float, height: float) -> None:
    thick, square = parts.between(0.02, 0.07), parts.chance(0.5)
    splay = parts.between(0.85, 1.2)
    x, y = depth / 2 - thick, width / 2 - thick
    for i in (-1, 1):
        for j in (-1, 1):
            parts.leg((i * x, j * y, height), (i * x * splay, j * y * splay, 0), thick, square)
    if parts.chance(0.3):
        at = height * parts.between(0.2, 0.5)
        for j in (-1, 1):
            parts.rod((-x, j * y, at), (x, j * y, at), thick / 3)


def _back(parts: Parts, width: float, depth: float, height: float, rise: float) -> None:
    """Add a back that leans, as a board, slats or bars, at the rear of a seat."""
    lean = rotation_about((0, 1, 0), -parts.between(0, 0.35))
    thick = parts.between(0.02, 0.07)

    def board(y: float, up: float, size: tuple[float, float, float]) -> None:
        offset = lean @ (0, 0, up)
        parts.box((offset[0] - depth / 2, y, height + offset[2]), size, lean)

    kind = parts.rng.integers(3)
    if kind == 0:
        board(0, rise / 2, (thick, width, rise))
        return
    for side in (-1, 1):
        board(side * (width - thick) / 2, rise / 2, (thick, thick, rise))
    count = int(parts.rng.integers(2, 5))
    for k in range(count):
        if kind == 1:
            board(0, rise * (k + 0.7) / count, (thick / 2, width, rise / count * 0.5))
        else:
            board(width * ((k + 1) / (count + 1) - 0.5), rise / 2, (thick / 2, thick / 2, rise))
    board(0, rise, (thick, width, thick))
