"""Procedural textures: the colour of a surface point from its material."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np

from datamodules.synthrooms.palette import Pattern

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from datamodules.synthrooms.palette import Material

    Floats = NDArray[np.float32]

__all__ = ["MaterialTable", "albedo"]

_NOISE: Floats = np.random.default_rng(0).random((256, 256), dtype=np.float32)
_NOISE_ROW = 1024  # cv2.remap takes at most 32,767 columns


class MaterialTable(NamedTuple):
    """The fields of many `Material`, one row each."""

    color: Floats
    second: Floats
    pattern: NDArray[np.int64]
    frequency: Floats
    contrast: Floats
    offset: Floats
    emission: Floats
    unscanned: NDArray[np.bool_]

    @classmethod
    def of(cls, materials: Sequence[Material]) -> MaterialTable:
        """Tabulate materials."""
        return cls(
            color=np.array([m.color for m in materials], np.float32),
            second=np.array([m.second for m in materials], np.float32),
            pattern=np.array([m.pattern for m in materials], np.int64),
            frequency=np.array([m.frequency for m in materials], np.float32),
            contrast=np.array([m.contrast for m in materials], np.float32),
            offset=np.array([m.offset for m in materials], np.float32),
            emission=np.array([m.emission for m in materials], np.float32),
            unscanned=np.array([m.unscanned for m in materials], np.bool_),
        )


def _noise(x: NDArray[np.floating[Any]], y: NDArray[np.floating[Any]]) -> Floats:
    """Smooth noise in [0, 1] with one knot per unit, the same everywhere and always."""
    size = -(-len(x) // _NOISE_ROW) * _NOISE_ROW
    xy = np.zeros((2, size), np.float32)
    xy[0, : len(x)], xy[1, : len(x)] = np.mod(x, 256), np.mod(y, 256)
    maps = xy.reshape(2, -1, _NOISE_ROW)
    noise = cv2.remap(_NOISE, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return noise.reshape(-1)[: len(x)]


def _hash(cell: Floats, salt: float) -> Floats:
    """One value in [0, 1] per integer `cell`."""
    return np.mod(np.abs(np.sin(cell * np.float32(12.9898 + salt)) * np.float32(437.5453)), 1)


def _stripes(u: Floats, v: Floats, f: Floats) -> Floats:
    return (np.mod(u * f, 1) < 0.45).astype(np.float32)


def _tiles(u: Floats, v: Floats, f: Floats) -> Floats:
    return ((np.mod(u * f, 1) < 0.05) | (np.mod(v * f, 1) < 0.05)).astype(np.float32)


def _wood(u: Floats, v: Floats, f: Floats) -> Floats:
    return 0.6 * _noise(u * 1.2, v * 24) + 0.4 * (np.mod(v * f, 1) < 0.04)


def _speckle(u: Floats, v: Floats, f: Floats) -> Floats:
    return _noise(u * 60, v * 60)


def _books(u: Floats, v: Floats, f: Floats) -> Floats:
    return _hash(np.floor(u * f), 0.0)


def _strokes(u: Floats, v: Floats, f: Floats) -> Floats:
    lines = np.abs(_noise(u * 7, v * f * 2.5) - 0.5) < 0.07
    return (lines & (_noise(u * 0.9, v * 0.9 + 40) > 0.3)).astype(np.float32)


def _papers(u: Floats, v: Floats, f: Floats) -> Floats:
    column, row = np.floor(u * f), np.floor(v * f * 0.75)
    inside = (np.mod(u * f, 1) > 0.15) & (np.mod(v * f * 0.75, 1) > 0.15)
    return (inside & (_hash(column + 57 * row, 1.0) > 0.4)).astype(np.float32)


def _outside(u: Floats, v: Floats, f: Floats) -> Floats:
    """Land below a ragged skyline, with the sky paling towards it."""
    skyline = 1.1 + 0.7 * (_noise(np.floor(u * 4 * f), u * 0) - 0.5)
    return np.where(v < skyline, 0.75 + 0.25 * _noise(u * 3, v * 3), 0).astype(np.float32)


_WEIGHTS: dict[int, Callable[[Floats, Floats, Floats], Floats]] = {
    Pattern.STRIPES: _stripes,
    Pattern.TILES: _tiles,
    Pattern.WOOD: _wood,
    Pattern.SPECKLE: _speckle,
    Pattern.BOOKS: _books,
    Pattern.STROKES: _strokes,
    Pattern.PAPERS: _papers,
    Pattern.OUTSIDE: _outside,
}


def albedo(
    materials: MaterialTable, rows: NDArray[np.int64], points: Floats, normals: Floats
) -> Floats:
    """Share of light that surface points throw back.

    Args:
        materials: The scene's materials.
        rows: ``(n,)`` material of every point.
        points: ``(n, 3)`` in metres; textures are laid over the dominant plane of the normal.
        normals: ``(n, 3)``.

    Returns:
        ``(n, 3)`` linear values in [0, 1].
    """
    axis = np.abs(normals).argmax(axis=1)
    u = np.where(axis == 0, points[:, 1], points[:, 0])
    v = np.where(axis == 2, points[:, 1], points[:, 2])
    pattern, frequency = materials.pattern[rows], materials.frequency[rows]
    offset = materials.offset[rows]
    color = materials.color[rows]
    weight = np.zeros(len(rows), np.float32)
    for kind, weigh in _WEIGHTS.items():
        chosen = np.flatnonzero(pattern == kind)
        if len(chosen) == 0:
            continue
        # The view outside keeps its horizon: everything else is shifted at random.
        shift = 0 if kind == Pattern.OUTSIDE else offset[chosen, 1]
        uc, vc, fc = u[chosen] + offset[chosen, 0], v[chosen] + shift, frequency[chosen]
        weight[chosen] = weigh(uc, vc, fc)
        if kind == Pattern.BOOKS:
            cell = np.floor(uc * fc)
            tint = np.stack([_hash(cell, salt) for salt in (2.0, 3.0, 4.0)], axis=1)
            color[chosen] = np.clip(color[chosen] * (0.5 + tint), 0, 1)
    color += weight[:, None] * (materials.second[rows] - color)
    coarse, fine = (_noise(u * k, v * k) - np.float32(0.5) for k in (2.3, 31.0))
    color *= (1 + materials.contrast[rows] * (2 * coarse + fine))[:, None]
    return np.clip(color, 0, 1, out=color) ** 2
