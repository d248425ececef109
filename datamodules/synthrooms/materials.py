"""Colors, materials and procedural textures, drawn per object from one palette per room.

All classes share the palette and most patterns, so that color alone does not give the class.
Colors are display values in [0, 1]; light is computed with their squares (a gamma of 2).
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Limits = tuple[float, float]
_COMMON_SHARES = (0.47, 0.1, 0.07, 0.2, 0.16)  # of the first patterns


class Material(NamedTuple):
    """Surface of one part of an object.

    Attributes:
        color: Main color, display values.
        second: The pattern's other color.
        pattern: Index of the procedural texture in `_PATTERNS`.
        frequency: Repetitions per meter.
        contrast: Strength of the fine mottling that every surface has.
        offset: Shift of the texture in meters.
        emission: Light that the surface emits, relative to its color; 0 for most.
        unscanned: True if depth cameras get no return from it, e.g. from some window glass.
    """

    color: NDArray[np.float64]
    second: NDArray[np.float64]
    pattern: int
    frequency: float
    contrast: float
    offset: NDArray[np.float64]
    emission: float = 0.0
    unscanned: bool = False

    def shaded(self, factor: float) -> Material:
        """Return the material in a lighter or darker color, without its pattern."""
        return self._replace(color=np.clip(self.color * factor, 0.02, 0.98), pattern=0)


SURFACE = np.dtype("3f4, 3f4, i8, f4, f4, 2f4, f4, ?", align=True)
SURFACE.names = Material._fields
"""A `Material` as an element of an array."""


class Palette:
    """Ten colors of a room, and materials drawn from them.

    Args:
        rng: The room's source of randomness.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        vivid = [self.hsv((0, 1), (0, 0.7), (0.2, 0.95)) for _ in range(5)]
        woody = [self.hsv((0.05, 0.12), (0.2, 0.65), (0.3, 0.85)) for _ in range(2)]
        self._colors = np.array([*vivid, *woody, *(self.pale() for _ in range(3))])

    def hsv(self, hue: Limits, saturation: Limits, value: Limits) -> NDArray[np.float64]:
        """Draw a color uniformly between the limits of hue, saturation and value."""
        drawn = [self._rng.uniform(*limits) for limits in (hue, saturation, value)]
        return np.array(colorsys.hsv_to_rgb(*drawn))

    def pale(self) -> NDArray[np.float64]:
        """Draw a light color with little saturation, common on walls."""
        return self.hsv((0, 1), (0, 0.14), (0.6, 0.97))

    def color(self) -> NDArray[np.float64]:
        """Draw one of the room's colors, slightly varied."""
        color = self._colors[self._rng.integers(len(self._colors))]
        varied = color * self._rng.uniform(0.75, 1.2) + self._rng.normal(0, 0.03, 3)
        return np.clip(varied, 0.04, 0.97)

    def material(
        self,
        *patterns: str,
        color: NDArray[np.float64] | None = None,
        frequency: Limits = (1.5, 8.0),
        **given: Any,
    ) -> Material:
        """Draw a material.

        Args:
            *patterns: Patterns to choose from; the common ones by default.
            color: Main color; one of the room's by default.
            frequency: Limits of the pattern's repetitions per meter.
            **given: Other attributes of `Material`, which are not drawn.
        """
        rng = self._rng
        base = self.color() if color is None else color
        second = np.clip(base * rng.uniform(0.5, 1.3) + rng.normal(0, 0.05, 3), 0.02, 0.98)
        if patterns:
            pattern = _PATTERNS.index(patterns[rng.integers(len(patterns))])
        else:
            pattern = int(rng.choice(len(_COMMON_SHARES), p=_COMMON_SHARES))
        repetitions, contrast = rng.uniform(*frequency), rng.uniform(0.03, 0.14)
        drawn = Material(base, second, pattern, repetitions, contrast, rng.uniform(0, 50, 2))
        return drawn._replace(**given)


_NOISE: Floats = np.random.default_rng(0).random((256, 256), dtype=np.float32)
_NOISE_ROW = 1024  # cv2.remap takes at most 32,767 columns


def _noise(x: NDArray[np.floating[Any]], y: NDArray[np.floating[Any]]) -> Floats:
    """Return smooth noise in [0, 1] with one knot per unit, the same in all rooms."""
    size = -(-len(x) // _NOISE_ROW) * _NOISE_ROW
    xy = np.zeros((2, size), np.float32)
    xy[:, : len(x)] = np.mod(x, 256), np.mod(y, 256)
    maps = xy.reshape(2, -1, _NOISE_ROW)
    noise = cv2.remap(_NOISE, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return noise.reshape(-1)[: len(x)]


def _hash(cell: Floats, salt: float) -> Floats:
    """Return a value in [0, 1] for every integer `cell`."""
    return np.mod(np.abs(np.sin(cell * np.float32(12.9898 + salt)) * np.float32(437.5453)), 1)


def _strokes(u: Floats, v: Floats, f: Floats) -> NDArray[Any]:
    lines = np.abs(_noise(u * 7, v * f * 2.5) - 0.5) < 0.07
    return lines & (_noise(u * 0.9, v * 0.9 + 40) > 0.3)


def _papers(u: Floats, v: Floats, f: Floats) -> NDArray[Any]:
    column, row = np.floor(u * f), np.floor(v * f * 0.75)
    inside = (np.mod(u * f, 1) > 0.15) & (np.mod(v * f * 0.75, 1) > 0.15)
    return inside & (_hash(column + 57 * row, 1.0) > 0.4)


def _outside(u: Floats, v: Floats, f: Floats) -> NDArray[Any]:
    """Return land below a ragged skyline, with the sky paling towards it."""
    skyline = 1.1 + 0.7 * (_noise(np.floor(u * 4 * f), u * 0) - 0.5)
    return np.where(v < skyline, 0.75 + 0.25 * _noise(u * 3, v * 3), 0)


_WEIGHTS: dict[str, Callable[[Floats, Floats, Floats], NDArray[Any]]] = {
    "stripes": lambda u, v, f: np.mod(u * f, 1) < 0.45,
    "tiles": lambda u, v, f: (np.mod(u * f, 1) < 0.05) | (np.mod(v * f, 1) < 0.05),
    "wood": lambda u, v, f: 0.6 * _noise(u * 1.2, v * 24) + 0.4 * (np.mod(v * f, 1) < 0.04),
    "speckle": lambda u, v, f: _noise(u * 60, v * 60),
    "books": lambda u, v, f: _hash(np.floor(u * f), 0.0),
    "strokes": _strokes,
    "papers": _papers,
    "outside": _outside,
}
"""Weight of the second color at positions u, v in meters, with f repetitions per meter."""

_PATTERNS = ("plain", *_WEIGHTS)
"""Procedural textures; the last four are for one kind of object each."""


def albedo(surface: NDArray[np.void], points: Floats, normals: Floats) -> Floats:
    """Return the albedo of surface points.

    Args:
        surface: ``(n,)`` material of every point, of type `SURFACE`; overwritten.
        points: ``(n, 3)`` in meters; textures are projected along the main axis of the normal.
        normals: ``(n, 3)``.

    Returns:
        ``(n, 3)`` linear values in [0, 1].
    """
    axis = np.abs(normals).argmax(axis=1)
    u = np.where(axis == 0, points[:, 1], points[:, 0])
    v = np.where(axis == 2, points[:, 1], points[:, 2])
    color = surface["color"]
    weight = np.zeros(len(surface), np.float32)
    for name, weigh in _WEIGHTS.items():
        chosen = np.flatnonzero(surface["pattern"] == _PATTERNS.index(name))
        if len(chosen) == 0:
            continue
        offset, frequency = surface["offset"][chosen], surface["frequency"][chosen]
        # The view outside keeps its horizon; other textures are shifted at random.
        shift = 0 if name == "outside" else offset[:, 1]
        u_shifted = u[chosen] + offset[:, 0]
        weight[chosen] = weigh(u_shifted, v[chosen] + shift, frequency)
        if name == "books":
            cell = np.floor(u_shifted * frequency)
            tint = np.stack([_hash(cell, salt) for salt in (2.0, 3.0, 4.0)], axis=1)
            color[chosen] = np.clip(color[chosen] * (0.5 + tint), 0, 1)
    color += weight[:, None] * (surface["second"] - color)
    coarse, fine = (_noise(u * k, v * k) - np.float32(0.5) for k in (2.3, 31.0))
    color *= (1 + surface["contrast"] * (2 * coarse + fine))[:, None]
    return np.clip(color, 0, 1) ** 2
