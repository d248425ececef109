"""Colours and materials, drawn per object from one palette per room.

All classes share the palette and most patterns, so that colour alone does not give the class.
Colours are display values in [0, 1]; light is computed with their squares (a gamma of 2).
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

__all__ = ["Material", "Palette", "Pattern"]


class Pattern(IntEnum):
    """Procedural textures; the last four belong to one kind of thing."""

    PLAIN = 0
    STRIPES = 1
    TILES = 2
    WOOD = 3
    SPECKLE = 4
    BOOKS = 5
    STROKES = 6
    PAPERS = 7
    OUTSIDE = 8


_COMMON = (Pattern.PLAIN, Pattern.STRIPES, Pattern.TILES, Pattern.WOOD, Pattern.SPECKLE)
_COMMON_SHARES = (0.47, 0.1, 0.07, 0.2, 0.16)


@dataclass(frozen=True)
class Material:
    """Surface of one part of an object.

    Attributes:
        color: Main colour, display values.
        second: The pattern's other colour.
        pattern: Procedural texture.
        frequency: Repetitions per metre.
        contrast: Strength of the fine mottling that every surface has.
        offset: Shift of the texture in metres.
        emission: Light the surface gives by itself, relative to its colour; 0 for most.
        unscanned: Whether a depth camera gets nothing back from it, as from some window glass.
    """

    color: NDArray[np.float64]
    second: NDArray[np.float64]
    pattern: Pattern
    frequency: float
    contrast: float
    offset: NDArray[np.float64]
    emission: float = 0.0
    unscanned: bool = False

    def shaded(self, factor: float) -> Material:
        """The same material in a lighter or darker colour, without its pattern."""
        color = np.clip(self.color * factor, 0.02, 0.98)
        return replace(self, color=color, pattern=Pattern.PLAIN)


class Palette:
    """Ten colours of a room, and materials made from them.

    Args:
        rng: The room's source of randomness.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        vivid = [self.hsv((0, 1), (0, 0.7), (0.2, 0.95)) for _ in range(5)]
        woody = [self.hsv((0.05, 0.12), (0.2, 0.65), (0.3, 0.85)) for _ in range(2)]
        pale = [self.pale() for _ in range(3)]
        self._colors = np.array([*vivid, *woody, *pale])

    def hsv(
        self, hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]
    ) -> NDArray[np.float64]:
        """A colour drawn uniformly between the limits of hue, saturation and value."""
        drawn = [self._rng.uniform(*limits) for limits in (hue, saturation, value)]
        return np.array(colorsys.hsv_to_rgb(*drawn))

    def pale(self) -> NDArray[np.float64]:
        """A light colour with little saturation, as walls often have."""
        return self.hsv((0, 1), (0, 0.14), (0.6, 0.97))

    def color(self) -> NDArray[np.float64]:
        """One of the room's colours, slightly varied."""
        color = self._colors[self._rng.integers(len(self._colors))]
        varied = color * self._rng.uniform(0.75, 1.2) + self._rng.normal(0, 0.03, 3)
        return np.clip(varied, 0.04, 0.97)

    def material(
        self,
        *patterns: Pattern,
        color: NDArray[np.float64] | None = None,
        second: NDArray[np.float64] | None = None,
        frequency: tuple[float, float] = (1.5, 8.0),
        emission: float = 0.0,
        unscanned: bool = False,
    ) -> Material:
        """Draw a material.

        Args:
            *patterns: Patterns to choose from; the common ones by default.
            color: Main colour; one of the room's by default.
            second: The pattern's colour; a relative of the main one by default.
            frequency: Limits of the pattern's repetitions per metre.
            emission: See `Material`.
            unscanned: See `Material`.
        """
        rng = self._rng
        base = self.color() if color is None else color
        related = np.clip(base * rng.uniform(0.5, 1.3) + rng.normal(0, 0.05, 3), 0.02, 0.98)
        return Material(
            color=base,
            second=related if second is None else second,
            pattern=self._pattern(patterns),
            frequency=rng.uniform(*frequency),
            contrast=rng.uniform(0.03, 0.14),
            offset=rng.uniform(0, 50, 2),
            emission=emission,
            unscanned=unscanned,
        )

    def _pattern(self, choices: Sequence[Pattern]) -> Pattern:
        if choices:
            return choices[int(self._rng.integers(len(choices)))]
        return _COMMON[self._rng.choice(len(_COMMON), p=_COMMON_SHARES)]
