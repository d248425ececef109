"""The set of tangent images of a panorama (paper, section 3.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.icosphere import icosphere, vertex_resolution
from tangent_train.geometry.pinhole_grid import SquareGrid

_MAX_LEVEL = 30  # a panorama of 2³¹ rows; much larger powers of two take too long to compute


class _FaceTable:
    """Data that depend only on the base level: centers, axes, extent of the cells."""

    def __init__(self, base_level: int) -> None:
        vertices, self.faces = icosphere(base_level)
        centers = vertices[self.faces].mean(axis=1)
        self.centers_xyz = centers / np.linalg.norm(centers, axis=1, keepdims=True)
        # No face center of the unrotated icosahedron is a pole: east is well defined.
        east = np.cross([0.0, 0.0, 1.0], self.centers_xyz)
        east /= np.linalg.norm(east, axis=1, keepdims=True)
        south = np.cross(east, self.centers_xyz)
        self.world_from_camera = np.stack([east, south, self.centers_xyz], axis=-1)
        self.faces_of_vertex = _group(self.faces, len(vertices))

    @cached_property
    def owned_extent(self) -> float:
        """Largest |x| or |y| on its tangent plane of the points that a face owns.

        The corners of the owned cells are the points with three nearest face centers; these faces
        meet at a vertex of the icosahedron.
        """
        stars = self.faces_of_vertex
        extent = 0.0
        for triple in combinations(range(stars.shape[1]), 3):
            members = stars[:, triple]
            a, b, c = np.moveaxis(self.centers_xyz[members], 1, 0)
            corner = np.cross(b - a, c - a)
            length = np.linalg.norm(corner, axis=1, keepdims=True)
            valid = length[:, 0] > 1e-12  # five faces at a pole of the mesh: the sixth is a repeat
            corner = corner / np.where(valid, length[:, 0], 1.0)[:, None]
            corner *= np.sign((corner * a).sum(axis=1, keepdims=True))
            closeness = np.einsum("vi,vfi->vf", corner, self.centers_xyz[stars])
            valid &= closeness.max(axis=1) - (corner * a).sum(axis=1) < 1e-12
            axes = self.world_from_camera[members[valid]]
            x, y, z = np.moveaxis(np.einsum("vi,vfic->vfc", corner[valid], axes), -1, 0)
            extent = max(extent, np.abs(np.stack([x, y]) / z).max(initial=0.0))
        return extent


def _group(faces: NDArray[np.int64], num_vertices: int) -> NDArray[np.int64]:
    """Return the faces around every vertex, ``(V, 6)``; where there are five, the first repeats."""
    corner = np.argsort(faces.ravel(), kind="stable")
    valence = np.bincount(faces.ravel(), minlength=num_vertices)
    start = np.cumsum(valence) - valence
    column = np.arange(6) % valence[:, None]
    return corner[start[:, None] + column] // 3


@lru_cache(maxsize=16)
def _face_table(base_level: int) -> _FaceTable:
    return _FaceTable(base_level)


@dataclass(frozen=True, eq=False, init=False)
class TangentGrid(SquareGrid):
    """N = 20·4^b pinhole images tangent to the faces of a level-b icosahedron.

    Pixel (row i, column j) of an image sits on its tangent plane at ``x = (j − (d−1)/2)·p`` to the
    east and ``y = −(i − (d−1)/2)·p`` to the north of the face's center, with the pitch
    ``p = R_v(b−1) / 2^(s−b)`` (paper, equations for d and for the tangent bounds): planar gnomonic
    coordinates. Every direction is *owned* by the face with the nearest center.

    Args:
        base_level: Base level b.
        level: Level s of the panorama, at least b.
        dim: Side d in pixels, default 2^(s−b). It changes the extent of the images and keeps the
            pitch: a smaller side crops towards the owned cell, a larger one adds a margin.
        rotation: ``(3, 3)`` proper rotation R of the whole icosahedron: directions become R·d.

    Raises:
        SettingError: A level is out of range, the rotation is not a rotation, or `dim` would leave
            part of an owned cell uncovered.

    >>> grid = TangentGrid(base_level=1, level=10)
    >>> grid.num_images, grid.dim, round(grid.fov_deg, 4)
    (80, 512, 51.6162)
    """

    base_level: int
    level: int
    size: tuple[int, int]
    rotation: NDArray[np.float64] | None

    def __init__(
        self,
        base_level: int,
        level: int,
        dim: int | None = None,
        rotation: ArrayLike | None = None,
    ) -> None:
        if not 0 <= base_level <= level:
            raise SettingError("base_level", found=base_level, expected=f"0 to level = {level}")
        if level > _MAX_LEVEL:
            raise SettingError("level", found=level, expected=f"at most {_MAX_LEVEL}")
        dim = 2 ** (level - base_level) if dim is None else dim
        if dim > 2**_MAX_LEVEL:
            raise SettingError("dim", found=dim, expected=f"at most {2**_MAX_LEVEL}")
        pitch = _pitch(base_level, level)
        self._set(rotation, base_level=base_level, level=level, size=(dim, dim), pitch=pitch)
        least = self.least_dim(base_level, level)
        if dim < least:
            raise SettingError(
                "dim",
                found=dim,
                expected=f"at least {least} at base level {base_level} and level {level}",
                remedy="Smaller images would leave parts of the sphere uncovered.",
            )

    @staticmethod
    def least_dim(base_level: int, level: int) -> int:
        """Return the smallest `dim` whose images cover every owned cell."""
        extent = _face_table(base_level).owned_extent
        return math.ceil(2 * extent / _pitch(base_level, level) - 1e-9) + 1

    @property
    def is_overlapping(self) -> bool:
        """Always True: even the smallest images reach half a pixel beyond the owned cells."""
        return True

    def _resting_axes(self) -> NDArray[np.float64]:
        return _face_table(self.base_level).world_from_camera


def _pitch(base_level: int, level: int) -> float:
    return vertex_resolution(base_level - 1) / float(2 ** (level - base_level))
