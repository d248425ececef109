"""The set of tangent images of a panorama (paper, section 3.2)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.cells import cell_corners
from tangent_train.geometry.icosphere import icosphere, vertex_resolution
from tangent_train.geometry.pinhole_grid import PinholeGrid

_MAX_LEVEL = 30  # a panorama of 2³¹ rows; much larger powers of two take too long to compute


class TangentGrid(PinholeGrid):
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

    def __init__(
        self,
        base_level: int,
        level: int,
        dim: int | None = None,
        rotation: ArrayLike | None = None,
    ) -> None:
        if not 0 <= base_level <= level <= _MAX_LEVEL:
            raise SettingError(
                "base_level and level",
                found=f"{base_level} and {level}",
                expected=f"0 ≤ base_level ≤ level ≤ {_MAX_LEVEL}",
            )
        dim = 2 ** (level - base_level) if dim is None else dim
        least = self.least_dim(base_level, level)
        if not least <= dim <= 2**_MAX_LEVEL:
            raise SettingError(
                "dim",
                found=dim,
                expected=f"at least {least} at base level {base_level} and level {level}",
                remedy="Smaller images would leave parts of the sphere uncovered.",
            )
        super().__init__(_face_axes(base_level), (dim, dim), _pitch(base_level, level), rotation)
        self.base_level = base_level
        self.level = level

    @staticmethod
    def least_dim(base_level: int, level: int) -> int:
        """Return the smallest `dim` whose images cover every owned cell."""
        return math.ceil(2 * _owned_extent(base_level) / _pitch(base_level, level) - 1e-9) + 1


@lru_cache(maxsize=16)
def _face_axes(base_level: int) -> NDArray[np.float64]:
    """Return the camera axes ``(N, 3, 3)`` of the faces; north is up."""
    vertices, faces = icosphere(base_level)
    centers = vertices[faces].mean(axis=1)
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    # No face center of the unrotated icosahedron is a pole: east is well defined.
    east = np.cross([0.0, 0.0, 1.0], centers)
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    return np.stack([east, np.cross(east, centers), centers], axis=-1)


@lru_cache(maxsize=16)
def _owned_extent(base_level: int) -> float:
    """Return the largest |x| or |y| on its tangent plane of the points that a face owns."""
    axes = _face_axes(base_level)
    faces, corners = cell_corners(axes[..., 2])
    x, y, z = np.moveaxis(np.einsum("ni,nfic->nfc", corners, axes[faces]), -1, 0)
    return float(np.abs(np.stack([x, y]) / z).max())


def _pitch(base_level: int, level: int) -> float:
    return vertex_resolution(base_level - 1) / float(2 ** (level - base_level))
