"""One face of the icosahedron under Loop subdivision: as good as the whole mesh, at 1/20 of it.

The icosahedron has a mirror plane through each of its edges and a fivefold axis through each
vertex, and Loop's rules keep both. So the vertices that the descendants of one face lie on follow
from themselves, and the other nineteen faces look the same: level 10 is one lattice of 1025²
numbers instead of a mesh of 21 million triangles.
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.icosphere import icosphere
from tangent_train.geometry.sphere import rotation_about

__all__ = ["MAX_LATTICE_LEVEL", "LoopLattice"]

MAX_LATTICE_LEVEL = 12
"""4097² vertices, a lattice of 0.4 GB; computing with it takes 3 GB."""

_FACES = 20
_BETA = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / 5) / 4) ** 2) / 5
"""Weight of a neighbour of a vertex that has five (Loop 1987); of one with six it is 1/16."""


class LoopLattice(NamedTuple):
    """The vertices below one face of the icosahedron after some Loop subdivisions.

    Attributes:
        level: Number of subdivisions.
        points: ``(n+1, n+1, 3)`` float64, n = 2^level. Those with i + j ≤ n are the vertices, the
            face's corners at (0, 0), (n, 0) and (0, n); the rest is 0. Neighbours of (i, j) are
            (i±1, j), (i, j±1), (i+1, j−1) and (i−1, j+1).
        mirrors: ``(3, 3, 3)`` reflections in the planes through the edges i = 0, j = 0, i + j = n.
    """

    level: int
    points: NDArray[np.float64]
    mirrors: NDArray[np.float64]

    @classmethod
    def at_level(cls, level: int) -> Self:
        """The lattice after `level` subdivisions.

        Raises:
            SettingError: The level is out of range.
        """
        if not 0 <= level <= MAX_LATTICE_LEVEL:
            expected = f"0 to {MAX_LATTICE_LEVEL}"
            raise SettingError("level of a subdivision", found=level, expected=expected)
        lattice = cls.of_icosahedron()
        for _ in range(level):
            lattice = lattice.subdivided()
        return lattice

    @classmethod
    def of_icosahedron(cls) -> Self:
        """The first face of `icosphere` (0)."""
        vertices, faces = icosphere(0)
        a, b, c = vertices[faces[0]]
        normals = np.cross([a, a, b], [c, b, c])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        mirrors = np.eye(3) - 2 * normals[:, :, None] * normals[:, None, :]
        points = np.zeros((2, 2, 3))
        points[0, 0], points[1, 0], points[0, 1] = a, b, c
        return cls(0, points, mirrors)

    def subdivided(self) -> Self:
        """The lattice after one more subdivision."""
        n = len(self.points) - 1
        p = self._with_neighbors()
        here, right, left = p[1:-1, 1:-1], p[2:, 1:-1], p[:-2, 1:-1]
        up, down, right_down, left_up = p[1:-1, 2:], p[1:-1, :-2], p[2:, :-2], p[:-2, 2:]
        fine = np.zeros((2 * n + 1, 2 * n + 1, 3))
        around = right + left + up + down + right_down + left_up
        fine[::2, ::2] = 5 / 8 * here + around / 16
        # On the three kinds of edges: to (i+1, j), to (i, j+1), and from (i+1, j) to (i, j+1).
        fine[1::2, ::2] = ((3 * (here + right) + up + right_down) / 8)[:-1]
        fine[::2, 1::2] = ((3 * (here + up) + right + left_up) / 8)[:, :-1]
        fine[1::2, 1::2] = ((3 * (right + up) + here + p[2:, 2:]) / 8)[:-1, :-1]
        i, j = np.ogrid[: 2 * n + 1, : 2 * n + 1]
        fine[i + j > 2 * n] = 0
        self._move_corners(fine)
        return self._replace(level=self.level + 1, points=fine)

    def _with_neighbors(self) -> NDArray[np.float64]:
        """``(n+3, n+3, 3)``: the points with a rim of those beyond the edges, their reflections.

        The rim's corners are missing: the face's corners have rules of their own.
        """
        n = len(self.points) - 1
        of_i, of_j, of_k = self.mirrors.transpose(0, 2, 1)
        p = np.zeros((n + 3, n + 3, 3))
        p[1:-1, 1:-1] = self.points
        k = np.arange(n)
        # (1, j) is beyond the edge i = 0 at (−1, j + 1), and so on; all indices here are one more.
        p[0, k + 2] = self.points[1, k] @ of_i
        p[k + 2, 0] = self.points[k, 1] @ of_j
        p[k + 2, n + 1 - k] = self.points[k, n - 1 - k] @ of_k
        return p

    def _move_corners(self, fine: NDArray[np.float64]) -> None:
        """Set the face's corners, whose five neighbours are turns of one about the corner."""
        n = len(self.points) - 1
        for corner, beside in (((0, 0), (1, 0)), ((n, 0), (n - 1, 0)), ((0, n), (0, n - 1))):
            old = self.points[corner]
            turns = [rotation_about(old, 2 * np.pi / 5 * k) for k in range(5)]
            around = np.sum([turn @ self.points[beside] for turn in turns], axis=0)
            fine[2 * corner[0], 2 * corner[1]] = (1 - 5 * _BETA) * old + _BETA * around

    @property
    def num_vertices(self) -> int:
        """Vertices of the whole mesh: 10·4^level + 2."""
        return 10 * 4**self.level + 2

    @property
    def num_faces(self) -> int:
        """Triangles of the whole mesh: 20·4^level."""
        return _FACES * int(4**self.level)

    def area(self, *, on_sphere: bool = False) -> float:
        """Area of the whole mesh.

        Args:
            on_sphere: With all vertices moved onto the unit sphere, along their directions.
        """
        p = _normalized(self.points) if on_sphere else self.points
        inside = self._inside()
        upward = _triangle_areas(p[:-1, :-1], p[1:, :-1], p[:-1, 1:])
        downward = _triangle_areas(p[1:, 1:], p[1:, :-1], p[:-1, 1:])
        return _FACES * float(upward[inside[:-1, 1:]].sum() + downward[inside[1:, 1:]].sum())

    def radii(self) -> tuple[float, float, float]:
        """Least, mean and greatest distance of the whole mesh's vertices from the centre."""
        radius = np.linalg.norm(self.points, axis=-1)
        inside = self._inside()
        mean = _FACES * (radius * self._shares())[inside].sum() / self.num_vertices
        return float(radius[inside].min()), float(mean), float(radius[inside].max())

    def vertex_resolution(self) -> float:
        """Mean over the whole mesh's vertices of the mean angle to the neighbours, in radians.

        The same as `tangent_train.geometry.vertex_resolution`, at levels that one does not reach.
        """
        unit = _normalized(self.points)
        shares = self._shares()
        # A vertex gives each of its angles to its mean: 1/6, or 1/5 at the face's corners.
        part = np.where(shares == 1 / 5, 1 / 5, 1 / 6)
        inside = self._inside()
        total = 0.0
        for a, b in (
            (np.s_[:-1, :], np.s_[1:, :]),
            (np.s_[:, :-1], np.s_[:, 1:]),
            (np.s_[1:, :-1], np.s_[:-1, 1:]),
        ):
            half_chord = np.linalg.norm(unit[a] - unit[b], axis=-1) / 2
            on_rim = self._on_one_edge(a, b)
            weight = (part[a] + part[b]) * np.where(on_rim, 0.5, 1.0) * (inside[a] & inside[b])
            total += float((2 * np.arcsin(half_chord) * weight).sum())
        return _FACES * total / self.num_vertices

    def _inside(self) -> NDArray[np.bool_]:
        i, j = np.ogrid[: len(self.points), : len(self.points)]
        return np.asarray(i + j < len(self.points))

    def _shares(self) -> NDArray[np.float64]:
        """``(n+1, n+1)`` the part of each vertex that is this face's: 1, ½ on edges, 1/5."""
        n = len(self.points) - 1
        i, j = np.ogrid[: n + 1, : n + 1]
        edges = (i == 0).astype(int) + (j == 0) + (i + j == n)
        return np.array([1, 1 / 2, 1 / 5])[np.minimum(edges, 2)]

    def _on_one_edge(self, a: tuple[slice, slice], b: tuple[slice, slice]) -> NDArray[np.bool_]:
        """Whether vertices a and their neighbours b lie on the same edge of the face."""
        n = len(self.points) - 1
        i, j = np.indices((n + 1, n + 1), dtype=np.int32)
        same = [(k[a] == edge) & (k[b] == edge) for k, edge in ((i, 0), (j, 0), (i + j, n))]
        return same[0] | same[1] | same[2]


def _normalized(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Onto the unit sphere; zeros stay."""
    length = np.linalg.norm(points, axis=-1, keepdims=True)
    return points / np.where(length == 0, 1, length)


def _triangle_areas(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.float64]:
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2
