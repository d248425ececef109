"""Shapes put together from primitives, as models from catalogues are: open, overlapping, uneven.

Everything is in metres, z up, and stands on z = 0; the front of a thing looks along +x.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from trimesh import creation, transformations

from datamodules.modelnet40.off_files import Mesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Point = Sequence[float]

__all__ = ["Parts"]

_ROD_SECTIONS = 12  # corners of what is round
_TURNED_SECTIONS = 24


class Parts:
    """A shape while it is made.

    Args:
        rng: Source of randomness of the shape.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._pieces: list[Mesh] = []

    def between(self, low: float, high: float) -> float:
        """A number drawn uniformly."""
        return float(self.rng.uniform(low, high))

    def chance(self, share: float) -> bool:
        """True as often as `share` says."""
        return bool(self.rng.random() < share)

    def mesh(self) -> Mesh:
        """All pieces as one mesh."""
        counts = np.cumsum([0, *(len(piece.vertices) for piece in self._pieces)])
        triangles = [p.triangles + n for p, n in zip(self._pieces, counts[:-1], strict=True)]
        return Mesh(
            np.concatenate([piece.vertices for piece in self._pieces]), np.concatenate(triangles)
        )

    def box(self, center: Point, size: Point, turn: Any = None) -> None:
        """A box; `turn` is a 3×3 rotation about its centre."""
        self._add(creation.box(extents=size), center, turn)

    def rod(self, start: Point, end: Point, radius: float, end_radius: float | None = None) -> None:
        """A round rod from one point to another, perhaps thinner at its end."""
        a, b = np.asarray(start, float), np.asarray(end, float)
        length = float(np.linalg.norm(b - a))
        last = radius if end_radius is None else end_radius
        outline = [(0, 0), (radius, 0), (last, length), (0, length)]
        turn = transformations.rotation_matrix(*_from_up((b - a) / length))[:3, :3]
        self._add(creation.revolve(outline, sections=_ROD_SECTIONS), a, turn)

    def leg(self, top: Point, foot: Point, thickness: float, square: bool) -> None:
        """A leg of a piece of furniture, round or square."""
        if not square:
            self.rod(foot, top, thickness / 2)
            return
        a, b = np.asarray(foot, float), np.asarray(top, float)
        length = float(np.linalg.norm(b - a))
        turn = transformations.rotation_matrix(*_from_up((b - a) / length))[:3, :3]
        self.box((a + b) / 2, (thickness, thickness, length), turn)

    def turned(self, outline: Sequence[Point], center: Point = (0, 0, 0)) -> None:
        """What a lathe makes of an outline of (radius, height)."""
        self._add(creation.revolve(outline, sections=_TURNED_SECTIONS), center)

    def ring(self, center: Point, radius: float, thickness: float, turn: Any = None) -> None:
        """A torus around z before the turn."""
        ring = creation.torus(radius, thickness, major_sections=20, minor_sections=8)
        self._add(ring, center, turn)

    def ellipsoid(self, center: Point, radii: Point, turn: Any = None) -> None:
        """An ellipsoid with these half axes along x, y, z before the turn."""
        ball = creation.icosphere(subdivisions=2)
        ball.apply_scale(radii)
        self._add(ball, center, turn)

    def panel(self, corners: Sequence[Point], thickness: float) -> None:
        """A plate with four corners in order, `thickness` along its normal."""
        points = np.asarray(corners, float)
        normal = np.cross(points[1] - points[0], points[3] - points[0])
        normal *= thickness / 2 / np.linalg.norm(normal)
        vertices = np.concatenate([points - normal, points + normal])
        faces = [[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]]
        for k in range(4):
            n = (k + 1) % 4
            faces += [[k, n, n + 4], [k, n + 4, k + 4]]
        self._pieces.append(Mesh(vertices, np.array(faces, np.int64)))

    def _add(self, piece: Any, place: Point | NDArray[np.float64], turn: Any = None) -> None:
        vertices = np.asarray(piece.vertices, np.float64)
        if turn is not None:
            vertices = vertices @ np.asarray(turn).T
        self._pieces.append(Mesh(vertices + place, np.asarray(piece.faces, np.int64)))


def _from_up(direction: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Angle and axis of a rotation that takes z to a unit vector."""
    axis = np.cross((0, 0, 1), direction)
    if np.linalg.norm(axis) < 1e-9:
        axis = np.array([1.0, 0, 0])
    return math.acos(float(np.clip(direction[2], -1, 1))), axis
