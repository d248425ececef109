"""The ten classes, and what individuals of all of them differ in."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import numpy as np

from datamodules.modelnet40.off_files import Mesh
from datamodules.synthshapes import furniture, vessels
from datamodules.synthshapes.parts import Parts
from tangent_train.geometry import rotation_about

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["CLASSES", "make_shape"]

_FAMILIES: dict[str, Callable[[Parts], None]] = {
    "airplane": vessels.airplane,
    "bench": furniture.bench,
    "bottle": vessels.bottle,
    "bowl": vessels.bowl,
    "chair": furniture.chair,
    "cup": vessels.cup,
    "lamp": furniture.lamp,
    "stool": furniture.stool,
    "table": furniture.table,
    "vase": vessels.vase,
}

CLASSES = tuple(_FAMILIES)
"""Names of the classes, in alphabetical order."""


def make_shape(seed: int, label: str, number: int) -> Mesh:
    """One shape, the same for the same arguments.

    Like models that people drew, it has its own units and origin, and a heading that is about that
    of its class.

    Args:
        seed: Seed of the data set.
        label: Class.
        number: Which of its class.
    """
    # The name, not its place: classes that are added later leave the others as they are.
    rng = np.random.default_rng((seed, zlib.crc32(label.encode()), number))
    parts = Parts(rng)
    _FAMILIES[label](parts)
    if parts.chance(0.25):
        _put_beside(parts)
    vertices, triangles = parts.mesh()
    # Stretched, narrower towards the top or the bottom a little.
    size = vertices.max(axis=0) - vertices.min(axis=0)
    stretch = np.exp(rng.normal(0, 0.12, 3))
    share = (vertices[:, 2:] - vertices[:, 2:].min()) / size[2] - 0.5
    taper = 1 + rng.normal(0, 0.08) * share
    vertices = vertices * stretch * np.concatenate([taper, taper, np.ones_like(taper)], axis=1)
    heading = rotation_about((0, 0, 1), rng.normal(0, 0.12))
    unit, origin = np.exp(rng.uniform(-3, 4)), rng.normal(0, 1, 3)
    return Mesh((vertices @ heading.T + origin * size) * unit, triangles)


def _put_beside(parts: Parts) -> None:
    """Some thing that is no part of the shape, on the ground next to it."""
    vertices = parts.mesh().vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = float(np.max(high - low)) * parts.between(0.06, 0.2)
    angle = parts.between(0, 2 * np.pi)
    reach = (high - low)[:2] / 2 + size
    x, y = (low + high)[:2] / 2 + reach * (np.cos(angle), np.sin(angle))
    center = (float(x), float(y), float(low[2]) + size)
    if parts.chance(0.5):
        parts.ellipsoid(center, (size, size, size))
    else:
        parts.box(center, [2 * size] * 3, rotation_about((0, 0, 1), angle))
