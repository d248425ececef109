"""Tables of convolutions on the icosphere, each a function of the level."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from models.mapped import Table
from tangent_train.geometry import icosphere
from tangent_train.registry import registered

_LEVELS = 9
"""Tables of one method that are kept: one per level of the icosphere."""


def unit_vertices(level: int) -> NDArray[np.float64]:
    """Return the directions ``(V, 3)`` of the vertices."""
    vertices = icosphere(level).vertices
    directions: NDArray[np.float64] = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return directions


@registered
@lru_cache(_LEVELS)
def mesh_operators(level: int) -> Table:
    """Return the four rows of MeshConv (Jiang et al. 2019, equation 3): x, L x, ∂EW x, ∂NS x.

    L is the cotangent Laplacian without division by the area of a vertex. The derivatives towards
    east and north are those of the linear function on each face, along EW = NS × n and the gradient
    NS of the latitude, averaged over the faces of a vertex by area. All are for a sphere of radius
    1. A pole has neither east nor north: its rows average the derivatives along NS and EW of its
    five faces, which tend to 0 for smooth functions.

    Args:
        level: Level s of the icosphere.
    """
    faces, points = icosphere(level).faces, unit_vertices(level)
    a, b, c = np.moveaxis(points[faces], 1, 0)
    double_normals = np.cross(b - a, c - a)
    double_areas = np.linalg.norm(double_normals, axis=1, keepdims=True)
    normals, areas = double_normals / double_areas, double_areas[:, 0] / 2
    opposite = np.stack([c - b, a - c, b - a], axis=1)
    gradients = np.cross(normals[:, None], opposite) / double_areas[:, None]  # (F, 3, 3)

    latitudes = np.arcsin(np.clip(points[:, 2], -1, 1))
    north = np.einsum("fi,fix->fx", latitudes[faces], gradients)
    outward = normals * np.sign((normals * a).sum(axis=1, keepdims=True))
    east = np.cross(north, outward)
    shares = areas[:, None] / np.bincount(faces.ravel(), np.repeat(areas, 3))[faces]

    at, of = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, 3).ravel()

    def assembled(entries: NDArray[np.float64]) -> sparse.csr_array:
        shape = len(points), len(points)
        return sparse.coo_array((entries.ravel(), (at, of)), shape).tocsr()

    laplacian = -areas[:, None, None] * np.einsum("fix,fjx->fij", gradients, gradients)
    derivatives = [
        shares[:, :, None] * np.einsum("fx,fjx->fj", along, gradients)[:, None]
        for along in (east, north)
    ]
    identity = sparse.eye_array(len(points), format="csr")
    return Table.of_operators([identity, *map(assembled, (laplacian, *derivatives))])
