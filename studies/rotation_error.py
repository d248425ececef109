"""Rotation errors of networks: ``python -m studies.rotation_error``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tangent_train.geometry.icosphere import icosphere
from tangent_train.geometry.icosphere_signals import icosphere_directions

Array = NDArray[np.float64]


def icosahedral_rotations() -> Array:
    """Return the ``(60, 3, 3)`` rotations that map the icosahedron to itself, the identity first.

    A rotation is determined by the directed edge to which it maps a given one.
    """
    corners, edges = (
        icosphere_directions(0),
        icosphere(0).faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2),
    )
    first, second = np.moveaxis(corners[edges], 1, 0)
    frames = np.stack([first, second, np.cross(first, second)], axis=-1)
    return frames @ np.linalg.inv(frames[0])


def vertices_after(rotation: Array, level: int) -> NDArray[np.int64]:
    """Return ``(V,)`` the vertex to which a rotation of the icosahedron maps each vertex."""
    directions = icosphere_directions(level)
    return np.asarray(cKDTree(directions).query(directions @ rotation.T)[1], np.int64)
