"""Icosahedron with vertices at both poles, and its Loop subdivisions."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError

MAX_LEVEL = 8


class Icosphere(NamedTuple):
    """A triangle mesh.

    Attributes:
        vertices: ``(V, 3)`` float64, not normalized: only their directions matter.
        faces: ``(F, 3)`` int64 vertex indices, all of one winding.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


def _icosahedron() -> Icosphere:
    """Return two poles and two rings of five vertices at latitudes ±atan ½."""
    lat = np.arctan(0.5)
    lon = 2 * np.pi / 5 * (np.arange(10) % 5 + np.repeat([0.0, 0.5], 5))
    z = np.repeat([np.sin(lat), -np.sin(lat)], 5)
    rings = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), z], axis=-1)
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], rings, [[0.0, 0.0, -1.0]]])
    k = np.arange(5)
    upper, upper_next, lower, lower_next = 1 + k, 1 + (k + 1) % 5, 6 + k, 6 + (k + 1) % 5
    north, south = np.zeros_like(k), np.full_like(k, 11)
    triangles = [
        (north, upper, upper_next),
        (upper, lower, upper_next),
        (upper_next, lower, lower_next),
        (south, lower_next, lower),
    ]
    faces = np.concatenate([np.stack(triangle, axis=-1) for triangle in triangles])
    return Icosphere(vertices, faces.astype(np.int64))


def _edges(faces: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return edges ``(E, 2)`` and, for each face, the edges opposite to its corners ``(F, 3)``."""
    corners = faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)
    edges, inverse = np.unique(np.sort(corners, axis=1), axis=0, return_inverse=True)
    return edges, inverse.reshape(-1, 3)


def _subdivide(mesh: Icosphere) -> Icosphere:
    """Apply one step of Loop subdivision to a closed mesh (Loop 1987)."""
    vertices, faces = mesh
    edges, edge_of_corner = _edges(faces)
    opposite = np.zeros((len(edges), 3))
    np.add.at(opposite, edge_of_corner.ravel(), vertices[faces.ravel()])
    on_edges = (3 * vertices[edges].sum(axis=1) + opposite) / 8

    valence = np.bincount(edges.ravel(), minlength=len(vertices))[:, None]
    around = np.zeros_like(vertices)
    for this, other in (edges.T, edges.T[::-1]):
        np.add.at(around, this, vertices[other])
    beta = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / valence) / 4) ** 2) / valence
    kept = (1 - valence * beta) * vertices + beta * around

    a, b, c = faces.T
    ea, eb, ec = edge_of_corner.T + len(vertices)
    children = [(a, ec, eb), (ec, b, ea), (eb, ea, c), (ea, eb, ec)]
    refined = np.stack([np.stack(child, axis=-1) for child in children], axis=1).reshape(-1, 3)
    return Icosphere(np.concatenate([kept, on_edges]), refined)


@lru_cache(maxsize=MAX_LEVEL + 1)
def icosphere(level: int) -> Icosphere:
    """Return the icosahedron after `level` Loop subdivisions, not normalized in between.

    Args:
        level: Number of subdivisions, 0 to 8.

    Returns:
        10·4^level + 2 vertices and 20·4^level faces; children of face f are 4f … 4f+3. Read-only.

    Raises:
        SettingError: The level is out of range.

    >>> icosphere(1).faces.shape
    (80, 3)
    """
    if not 0 <= level <= MAX_LEVEL:
        raise SettingError("icosphere level", found=level, expected=f"0 to {MAX_LEVEL}")
    mesh = _icosahedron() if level == 0 else _subdivide(icosphere(level - 1))
    for array in mesh:
        array.setflags(write=False)
    return mesh


@lru_cache(maxsize=MAX_LEVEL + 2)
def vertex_resolution(base_level: int) -> float:
    """Return R_v: the mean over vertices of the mean angle to their neighbors (section 3.2).

    Args:
        base_level: Level b, −1 to 8; R_v(−1) is defined as 2 R_v(0).

    Returns:
        Radians.

    Raises:
        SettingError: The level is out of range.

    >>> round(vertex_resolution(0), 7)
    1.1071487
    """
    if base_level == -1:
        return 2 * vertex_resolution(0)
    vertices, faces = icosphere(base_level)
    edges, _ = _edges(faces)
    a, b = np.moveaxis(vertices[edges], 1, 0)
    angles = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
    total = np.bincount(edges.ravel(), np.repeat(angles, 2), minlength=len(vertices))
    return float(np.mean(total / np.bincount(edges.ravel(), minlength=len(vertices))))
