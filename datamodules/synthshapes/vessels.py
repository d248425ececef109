"""Families of vessels, surfaces of revolution of similar outlines; and airplanes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import PchipInterpolator

from datamodules.synthshapes.parts import Parts, Point
from tangent_train.geometry import rotation_about


def bottle(parts: Parts) -> None:
    """Build a body with a neck, some with a cap or a handle, some without a clear shoulder."""
    height = parts.between(0.15, 0.4)
    radius = height * parts.between(0.12, 0.32)
    neck = radius * parts.between(0.22, 0.75)
    shoulder = height * parts.between(0.4, 0.78)
    slope = shoulder + (height - shoulder) * parts.between(0.2, 0.8)
    waist = radius * parts.between(0.8, 1.08)
    foot = radius * parts.between(0.7, 1)
    body = [(foot, 0), (radius, height * 0.06), (waist, shoulder * 0.5), (radius, shoulder)]
    outline = _curve(body, [(neck, slope), (neck * parts.between(1, 1.25), height)])
    parts.revolved([(0, 0), *outline, *([(0, height)] if parts.chance(0.35) else [])])
    if parts.chance(0.35):
        cap, top = neck * parts.between(1.05, 1.5), height * parts.between(1.02, 1.12)
        parts.revolved([(cap, height * 0.94), (cap, top), (0, top)])
    if parts.chance(0.15):
        _handle(parts, radius, height * 0.5, height * parts.between(0.12, 0.2))


def vase(parts: Parts) -> None:
    """Build a belly below a mouth, narrow or wide; or straight. Few have handles or a lid."""
    height = parts.between(0.12, 0.45)
    belly = height * parts.between(0.14, 0.45)
    foot = belly * parts.between(0.4, 1)
    if parts.chance(0.25):
        mouth = belly * parts.between(0.85, 1.5)
        outline = _curve([(foot, 0), (belly, height * parts.between(0.3, 0.7)), (mouth, height)])
    else:
        neck = belly * parts.between(0.25, 0.9)
        widest, narrow = height * parts.between(0.25, 0.65), height * parts.between(0.75, 0.92)
        mouth = neck * parts.between(1.0, 1.7)
        outline = _curve([(foot, 0), (belly, widest), (neck, narrow), (mouth, height)])
    if parts.chance(0.5):
        _walled(parts, outline, belly * parts.between(0.04, 0.12))
    else:
        parts.revolved([(0, 0), *outline])
    if parts.chance(0.2):
        parts.revolved([(mouth * 1.05, height), (mouth * 0.4, height * 1.06), (0, height * 1.1)])
    if parts.chance(0.2):
        for side in (-1, 1) if parts.chance(0.6) else (1,):
            at = height * parts.between(0.4, 0.6)
            _handle(parts, side * belly * 0.9, at, height * parts.between(0.1, 0.25))


def cup(parts: Parts) -> None:
    """Build an open cup with a wall; most have a handle, some a foot."""
    height = parts.between(0.06, 0.15)
    top = height * parts.between(0.28, 0.9)
    bottom = top * parts.between(0.45, 1.05)
    lift = height * parts.between(0.15, 0.6) if parts.chance(0.2) else 0.0
    if lift:
        parts.rod((0, 0, 0), (0, 0, lift), top * 0.1)
        parts.revolved([(0, 0), (top * 0.7, 0), (0, height * 0.05)])
    bulge = (bottom + top) / 2 * parts.between(0.9, 1.2)
    outside = _curve([(bottom, lift), (bulge, lift + height / 2), (top, lift + height)])
    _walled(parts, outside, top * parts.between(0.04, 0.12))
    if parts.chance(0.55):
        size = height * parts.between(0.22, 0.36)
        _handle(parts, bulge * 0.97, lift + height * parts.between(0.45, 0.6), size)


def bowl(parts: Parts) -> None:
    """Build a bowl: wide and open, deep or flat, some on a foot, few with handles."""
    radius = parts.between(0.07, 0.2)
    height = radius * parts.between(0.35, 1.8)
    foot = radius * parts.between(0.2, 0.8)
    power = parts.between(1.2, 3.2)
    steps = np.linspace(0, 1, 9)
    radii = foot + (radius - foot) * (1 - (1 - steps) ** power) ** (1 / power)
    outside = [(float(r), float(height * s)) for r, s in zip(radii, steps, strict=True)]
    _walled(parts, outside, radius * parts.between(0.02, 0.1))
    if parts.chance(0.4):
        low = -height * parts.between(0.1, 0.4)
        parts.revolved([(foot, 0), (foot * parts.between(0.8, 1.2), low)])
    if parts.chance(0.2):
        for side in (-1, 1) if parts.chance(0.6) else (1,):
            _handle(parts, side * radius * 0.95, height * 0.65, height * 0.25)


def airplane(parts: Parts) -> None:
    """Build a fuselage with wings, a tail and engines; liners, gliders, fighters."""
    length = parts.between(8, 40)
    radius = length * parts.between(0.035, 0.075)
    parts.ellipsoid((0, 0, 0), (length / 2, radius, radius * parts.between(0.85, 1.2)))
    if parts.chance(0.6):
        parts.rod((-length * 0.3, 0, 0), (length * 0.3, 0, 0), radius)
    span, chord = length * parts.between(0.3, 0.75), length * parts.between(0.1, 0.28)
    sweep, rise = length * parts.between(-0.05, 0.25), length * parts.between(-0.03, 0.06)
    at, height = length * parts.between(-0.05, 0.15), radius * parts.between(-0.7, 0.8)
    taper = parts.between(0.2, 0.9)
    _wings(parts, (at, height), (span, chord, taper), sweep, rise)
    tail = length * parts.between(0.08, 0.2)
    top = radius * 0.5 + (tail if parts.chance(0.3) else 0)
    rear = -length * parts.between(0.4, 0.47)
    _wings(parts, (rear, top), (tail, tail * 0.6, taper), tail * 0.4, 0)
    fin: list[Point] = [(rear - tail * 0.3, 0, 0), (rear + tail * 0.4, 0, 0)]
    fin += [(rear - tail * 0.3, 0, tail * 1.1), (rear - tail * 0.7, 0, tail * 1.1)]
    parts.panel(fin, length * 0.008)
    for k in range(int(parts.rng.integers(0, 3))):
        y, size = span * (0.35 + 0.3 * k), radius * parts.between(0.3, 0.55)
        x = at - sweep * (0.35 + 0.3 * k)
        for side in (-1, 1):
            z = height - size
            parts.rod((x, side * y, z), (x + chord * 0.8, side * y, z), size)


def _wings(
    parts: Parts,
    place: tuple[float, float],
    size: tuple[float, float, float],
    sweep: float,
    rise: float,
) -> None:
    """Add two wings that begin at x and z of `place`; `size` is span, chord and taper."""
    (x, z), (span, chord, taper) = place, size
    for side in (-1, 1):
        tip = x - sweep
        corners = [(x + chord / 2, 0, z), (tip + chord * taper / 2, side * span, z + rise)]
        corners += [(tip - chord * taper / 2, side * span, z + rise), (x - chord / 2, 0, z)]
        parts.panel(corners, chord * 0.08)


def _walled(parts: Parts, outside: Sequence[tuple[float, float]], wall: float) -> None:
    """Add an open vessel with a bottom and a wall; the outline rises."""
    low = outside[0][1]
    inside = [(max(r - wall, 0.001), max(z, low + wall)) for r, z in reversed(outside)]
    parts.revolved([(0, low), *outside, *inside, (0, low + wall)])


def _handle(parts: Parts, x: float, z: float, size: float) -> None:
    """Add an upright ring, half of it inside the vessel."""
    upright = rotation_about((1, 0, 0), math.pi / 2)
    parts.ring((x, 0, z), size, size * parts.between(0.12, 0.25), upright)


def _curve(*groups: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the points of an outline, each group smoothed separately."""
    outline: list[tuple[float, float]] = []
    for group in groups:
        radius, height = np.array(group).T
        if len(group) > 2:  # a cubic through the points, which rise, in ten pieces
            fine = np.linspace(height[0], height[-1], 11)
            radius, height = PchipInterpolator(height, radius)(fine), fine
        outline += list(zip(radius.tolist(), height.tolist(), strict=True))
    return outline
