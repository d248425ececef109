"""The set of tangent images of a panorama (paper, section 3.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.icosphere import icosphere, vertex_resolution
from tangent_train.geometry.sphere import checked_rotation

__all__ = ["Faces", "TangentGrid"]

Faces = Sequence[int] | NDArray[np.integer]
"""Indices of tangent images."""


class _FaceTable:
    """What depends on the base level alone: centres, axes, neighbours, the reach of a cell."""

    def __init__(self, base_level: int) -> None:
        vertices, self.faces = icosphere(base_level)
        centers = vertices[self.faces].mean(axis=1)
        self.centers_xyz = centers / np.linalg.norm(centers, axis=1, keepdims=True)
        # No face centre of the unrotated icosahedron is a pole: east is well defined.
        east = np.cross([0.0, 0.0, 1.0], self.centers_xyz)
        east /= np.linalg.norm(east, axis=1, keepdims=True)
        south = np.cross(east, self.centers_xyz)
        self.world_from_camera = np.stack([east, south, self.centers_xyz], axis=-1)
        self.faces_of_vertex = _group(self.faces, len(vertices))

    @cached_property
    def neighbors(self) -> NDArray[np.int32]:
        """``(N, 12)`` faces that share a vertex with a face, filled up with the face itself."""
        around = np.sort(self.faces_of_vertex[self.faces].reshape(len(self.faces), -1), axis=1)
        own = np.arange(len(self.faces))[:, None]
        repeated = np.pad(around[:, 1:] == around[:, :-1], ((0, 0), (1, 0)))
        around = np.where(repeated, own, around)
        order = np.argsort(around == own, axis=1, kind="stable")[:, :12]
        return np.take_along_axis(around, order, axis=1).astype(np.int32)

    @cached_property
    def owned_extent(self) -> float:
        """Largest |x| or |y| on its tangent plane of any point a face owns.

        The corners of the owned cells are the points with three nearest face centres; those three
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
    """``(V, 6)`` faces around every vertex; where there are five, the first stands twice."""
    corner = np.argsort(faces.ravel(), kind="stable")
    valence = np.bincount(faces.ravel(), minlength=num_vertices)
    start = np.cumsum(valence) - valence
    column = np.arange(6) % valence[:, None]
    return corner[start[:, None] + column] // 3


@lru_cache(maxsize=16)
def _face_table(base_level: int) -> _FaceTable:
    return _FaceTable(base_level)


@dataclass(frozen=True, eq=False, init=False)
class TangentGrid:
    """N = 20·4^b pinhole images tangent to the faces of a level-b icosahedron.

    Pixel (row i, column j) of an image sits on its tangent plane at ``x = (j − (d−1)/2)·p`` to the
    east and ``y = −(i − (d−1)/2)·p`` to the north of the face's centre, with the pitch
    ``p = R_v(b−1) / 2^(s−b)`` (paper, equations for d and for the tangent bounds): planar gnomonic
    coordinates. Every direction is *owned* by the face with the nearest centre.

    Args:
        base_level: Base level b.
        level: Level s of the panorama, at least b.
        dim: Side d in pixels, default 2^(s−b). It changes the extent of the images, never the
            pitch: less crops towards the owned cell, more adds a margin.
        rotation: ``(3, 3)`` proper rotation R that turns the whole icosahedron: directions become
            R·d.

    Raises:
        SettingError: A level is out of range, the rotation is none, or `dim` would leave part of
            an owned cell uncovered.

    >>> grid = TangentGrid(base_level=1, level=10)
    >>> grid.num_images, grid.dim, round(grid.fov_deg, 4)
    (80, 512, 51.6162)
    """

    base_level: int
    level: int
    dim: int
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
        values = {
            "base_level": base_level,
            "level": level,
            "dim": 2 ** (level - base_level) if dim is None else dim,
            "rotation": None if rotation is None else checked_rotation(rotation),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self._check_coverage()

    @staticmethod
    def least_dim(base_level: int, level: int) -> int:
        """The least `dim` whose images cover every owned cell."""
        extent = _face_table(base_level).owned_extent
        return math.ceil(2 * extent / _pitch(base_level, level) - 1e-9) + 1

    def _check_coverage(self) -> None:
        least = self.least_dim(self.base_level, self.level)
        if self.dim < least:
            raise SettingError(
                "dim",
                found=self.dim,
                expected=f"at least {least} at base level {self.base_level} and level {self.level}",
                remedy="Smaller images would leave parts of the sphere uncovered.",
            )

    @property
    def num_images(self) -> int:
        """N = 20·4^b."""
        return int(20 * 4**self.base_level)

    @property
    def pitch(self) -> float:
        """Distance of neighbouring pixels on the tangent plane, in focal lengths."""
        return _pitch(self.base_level, self.level)

    @property
    def half_extent(self) -> float:
        """Half extent h = (d−1)/2·p: where the outermost pixel centres are on the tangent plane."""
        return (self.dim - 1) / 2 * self.pitch

    @property
    def fov_deg(self) -> float:
        """Angle between adjacent corners in degrees: acos(1 / (1 + 2h²)) (paper, table of FOV)."""
        return math.degrees(math.acos(1 / (1 + 2 * self.half_extent**2)))

    @property
    def camera_matrix(self) -> NDArray[np.float64]:
        """``(3, 3)`` pinhole matrix of every image: focal length 1/p, centre (d−1)/2."""
        center = (self.dim - 1) / 2
        return np.array([[1 / self.pitch, 0, center], [0, 1 / self.pitch, center], [0, 0, 1]])

    @cached_property
    def centers_xyz(self) -> NDArray[np.float64]:
        """``(N, 3)`` directions of the images' centres."""
        return self.world_from_camera[..., 2]

    @cached_property
    def world_from_camera(self) -> NDArray[np.float64]:
        """``(N, 3, 3)`` camera axes (x right, y down, z forward) as columns.

        The determinant is −1, because the sphere frame is mirrored (see `tangent_train.geometry`);
        ``FLIP_Y @ world_from_camera`` are proper rotations in a right-handed room.
        """
        axes = _face_table(self.base_level).world_from_camera
        if self.rotation is not None:
            axes = self.rotation @ axes
        axes = axes.copy()
        axes.setflags(write=False)
        return axes

    @property
    def neighbors(self) -> NDArray[np.int32]:
        """``(N, 12)`` faces that share a vertex with a face, filled up with the face itself.

        Walking to ever nearer centres over these neighbours ends at the owner.
        """
        return _face_table(self.base_level).neighbors

    def directions(self, faces: Faces | None = None) -> NDArray[np.float64]:
        """Directions of the pixel centres.

        Args:
            faces: Images asked for, default all.

        Returns:
            ``(n, d, d, 3)`` unit vectors.

        Raises:
            SettingError: A face is out of range.
        """
        line = (np.arange(self.dim) - (self.dim - 1) / 2) * self.pitch
        x, y = np.meshgrid(line, line)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        axes = self.world_from_camera[self.face_indices(faces)]
        return np.einsum("nwc,ijc->nijw", axes, rays)

    def face_indices(self, faces: Faces | None = None) -> NDArray[np.int64]:
        """Checked indices of images, default all.

        Raises:
            SettingError: A face is out of range or no whole number.
        """
        if faces is None:
            return np.arange(self.num_images)
        indices = np.atleast_1d(np.asarray(faces))
        whole = indices.size == 0 or np.issubdtype(indices.dtype, np.integer)
        if not whole or indices.ndim != 1 or np.any((indices < 0) | (indices >= self.num_images)):
            raise SettingError("faces", found=faces, expected=f"indices 0 to {self.num_images - 1}")
        return indices.astype(np.int64)

    def owners(self, directions_xyz: ArrayLike) -> NDArray[np.int64]:
        """The face that owns each direction: the one with the nearest centre.

        Args:
            directions_xyz: ``(..., 3)`` vectors of any length.

        Returns:
            ``(...)`` face indices.
        """
        directions = np.asarray(directions_xyz, np.float64)
        flat = directions.reshape(-1, 3)
        owner = np.empty(len(flat), np.int64)
        step = max(1, 2**24 // self.num_images)
        for start in range(0, len(flat), step):
            part = slice(start, start + step)
            owner[part] = (flat[part] @ self.centers_xyz.T).argmax(axis=1)
        return owner.reshape(directions.shape[:-1])

    def project(self, directions_xyz: ArrayLike, faces: ArrayLike) -> NDArray[np.float64]:
        """Pixel positions of directions in given tangent images.

        Args:
            directions_xyz: ``(..., 3)`` vectors of any length.
            faces: Face of each direction, broadcast against ``(...)``.

        Returns:
            ``(..., 2)`` column and row; NaN where the direction is behind the image.
        """
        axes = self.world_from_camera[np.asarray(faces)]
        x, y, z = np.moveaxis(
            np.einsum("...w,...wc->...c", np.asarray(directions_xyz, np.float64), axes), -1, 0
        )
        depth = np.where(z > 0, z, np.nan)
        return np.stack([x / depth, y / depth], axis=-1) / self.pitch + (self.dim - 1) / 2

    def _key(self) -> tuple[object, ...]:
        rotation = None if self.rotation is None else self.rotation.tobytes()
        return self.base_level, self.level, self.dim, rotation

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TangentGrid) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())


def _pitch(base_level: int, level: int) -> float:
    return vertex_resolution(base_level - 1) / float(2 ** (level - base_level))
