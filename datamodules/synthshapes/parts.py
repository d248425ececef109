"""Shapes composed of trimesh's primitives, like models in catalogs: open, overlapping, uneven.

Everything is in meters, z up, and stands on z = 0; the front of an object faces +x.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from trimesh import Trimesh, creation, util
from trimesh.convex import convex_hull
from trimesh.geometry import align_vectors

Point = Sequence[float]


class Parts:
    """A shape under construction.

    Args:
        rng: Random generator of the shape.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._pieces: list[Trimesh] = []

    def between(self, low: float, high: float) -> float:
        """Draw a number uniformly."""
        return float(self.rng.uniform(low, high))

    def chance(self, share: float) -> bool:
        """Return True with a probability."""
        return bool(self.rng.random() < share)

    def mesh(self) -> Trimesh:
        """Return all pieces as one mesh."""
        return util.concatenate(self._pieces)

    def box(self, center: Point, size: Point, rotation: Any = None) -> None:
        """Add a box, rotated (3×3) about its center."""
        self._add(creation.box(size), center, rotation)

    def rod(self, start: Point, end: Point, radius: float) -> None:
        """Add a round rod from one point to another."""
        self._pieces.append(creation.cylinder(radius, segment=(start, end), sections=12))

    def leg(self, top: Point, foot: Point, thickness: float, square: bool) -> None:
        """Add a leg of a piece of furniture, round or square."""
        if not square:
            self.rod(foot, top, thickness / 2)
            return
        along = np.subtract(top, foot)
        rotation = align_vectors((0, 0, 1), along)[:3, :3]
        size = (thickness, thickness, float(np.linalg.norm(along)))
        self._add(creation.box(size), np.add(foot, top) / 2, rotation)

    def revolved(self, outline: Sequence[Point], center: Point = (0, 0, 0)) -> None:
        """Add the surface of revolution of an outline of (radius, height)."""
        self._add(creation.revolve(outline, sections=24), center)

    def ring(self, center: Point, radius: float, thickness: float, rotation: Any = None) -> None:
        """Add a torus around z before the rotation."""
        torus = creation.torus(radius, thickness, major_sections=20, minor_sections=8)
        self._add(torus, center, rotation)

    def ellipsoid(self, center: Point, radii: Point) -> None:
        """Add an ellipsoid with these half axes along x, y, z."""
        self._add(creation.icosphere(subdivisions=2).apply_scale(radii), center)

    def panel(self, corners: Sequence[Point], thickness: float) -> None:
        """Add a convex plate with four corners, `thickness` along its normal."""
        points = np.asarray(corners, float)
        normal = np.cross(points[1] - points[0], points[3] - points[0])
        normal *= thickness / 2 / np.linalg.norm(normal)
        self._pieces.append(convex_hull(np.concatenate([points - normal, points + normal])))

    def _add(self, piece: Trimesh, center: Any, rotation: Any = None) -> None:
        transform = np.eye(4)
        transform[:3, :3] = np.eye(3) if rotation is None else rotation
        transform[:3, 3] = center
        self._pieces.append(piece.apply_transform(transform))
