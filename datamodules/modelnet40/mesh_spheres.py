"""What a mesh looks like from the sphere around it: distances and slants that rays meet.

The recipe is that of Cohen et al., Spherical CNNs (2018), which the paper follows. A mesh is moved
so that the centroid of its surface is in the middle, and scaled to reach to `RADIUS`. A ray starts
at every point of the unit sphere that is the direction of a pixel of an equirectangular image, and
goes inward through the middle. Three channels tell about its first hit, three more about that of
the convex hull of the mesh:

==== ============================================== ==========
0, 3 distance t from the unit sphere                1 if none
1, 4 ``|n·r|``: n the normal there, r the direction 0 if none
2, 5 ``|n×r|``                                      0 if none
==== ============================================== ==========

The axes of the mesh are those of the panorama: z is up, and the y axis is in the middle of its
right half. So the image shows the mesh as it is seen from outside, and not mirrored.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from scipy.spatial import ConvexHull, QhullError

from datamodules.modelnet40.off_files import Mesh
from tangent_train.errors import DataError
from tangent_train.geometry import equirect_directions

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["CHANNELS", "RADIUS", "clean_mesh", "mesh_spheres"]

CHANNELS = 6
"""Of the mesh and of its convex hull, three each."""

RADIUS = 0.99
"""Distance of the farthest vertex from the middle."""

_CELLS = 2**20
"""Vertices in one cell of a grid of so many, in the longest extent of the mesh, are one vertex."""

_LEAST_HEIGHT = 1e-8
"""Triangles whose height is less than this part of the longest extent are none."""


def clean_mesh(mesh: Mesh) -> Mesh:
    """A mesh without what counts twice or not at all, in the middle of the unit sphere.

    Vertices in one place are merged; triangles without area, and all but one of those with the same
    vertices, are dropped. Then the centroid of the surface, which needs not be closed, is moved to
    the middle, and the mesh is scaled to `RADIUS`.

    Args:
        mesh: Any triangles.

    Raises:
        DataError: There is no surface, or its size is beyond numbers.
    """
    used, corners = np.unique(mesh.triangles, return_inverse=True)
    low = mesh.vertices[used].min(axis=0)
    with np.errstate(over="ignore"):
        extent = float(np.max(mesh.vertices[used].max(axis=0) - low))
    if not 0 < extent < np.inf:
        raise DataError("mesh", found=f"an extent of {extent:g}", expected="a surface")
    vertices = (mesh.vertices[used] - low) / extent
    corners = _merged(vertices)[corners.reshape(-1, 3)]
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    # Twice the area over the longest side.
    sides = np.stack([b - a, c - b, a - c])
    longest = np.sqrt(np.einsum("sij,sij->si", sides, sides).max(axis=0))
    doubled = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    kept = np.flatnonzero(doubled > _LEAST_HEIGHT * longest)
    kept = kept[_first_of_each(corners[kept], len(vertices))]
    if not len(kept):
        raise DataError("mesh", found="no triangle with an area", expected="a surface")
    centers = (a[kept] + b[kept] + c[kept]) / 3
    centroid = np.average(centers, axis=0, weights=doubled[kept])
    referenced, triangles = np.unique(corners[kept], return_inverse=True)
    vertices = vertices[referenced] - centroid
    vertices *= RADIUS / np.linalg.norm(vertices, axis=1).max()
    return Mesh(vertices, triangles.reshape(-1, 3))


def _merged(vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """For every vertex ``(V,)`` of [0, 1]³ the first one in its place."""
    cells = np.rint(vertices * _CELLS).astype(np.int64)
    keys = (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return first[inverse]


def _first_of_each(corners: NDArray[np.int64], vertices: int) -> NDArray[np.int64]:
    """Places ``(m,)`` of the first of every kind of triangles, whatever their orientation."""
    low, middle, high = np.sort(corners, axis=1).T
    _, pair = np.unique(low * vertices + middle, return_inverse=True)
    _, first = np.unique(pair * vertices + high, return_index=True)
    return np.sort(first)


def mesh_spheres(mesh: Mesh, shape: tuple[int, int]) -> NDArray[np.float64]:
    """The spherical images of a mesh and of its convex hull.

    A flat mesh has no hull: it is its own.

    Args:
        mesh: From `clean_mesh`.
        shape: ``(H, W)`` of the equirectangular images.

    Returns:
        ``(H, W, 6)`` channels; distances are below 2, slants at most 1.
    """
    directions = equirect_directions(shape).reshape(-1, 3)
    try:
        hull = mesh._replace(triangles=ConvexHull(mesh.vertices).simplices.astype(np.int64))
    except QhullError:
        hull = mesh
    images = [_cast(surface, directions) for surface in (mesh, hull)]
    return np.concatenate(images, axis=1).reshape(*shape, CHANNELS)


def _cast(mesh: Mesh, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance, ``|n·r|`` and ``|n×r|`` of first hits of rays inward, ``(n, 3)``."""
    triangles = mesh.vertices[mesh.triangles]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Robust: no ray slips through between two triangles that share an edge.
    tree = EmbreeScene(robust=True)
    _keep = TriangleMesh(tree, triangles.astype(np.float32))
    origins = directions.astype(np.float32)
    answer = tree.run(origins, -origins, query="INTERSECT", output=1)
    hit = np.flatnonzero(answer["primID"] >= 0)
    normal, ray = normals[answer["primID"][hit]], directions[hit]
    image = np.zeros((len(directions), 3))
    image[:, 0] = 1
    image[hit, 0] = answer["tfar"][hit]
    image[hit, 1] = np.abs(np.einsum("ij,ij->i", normal, ray))
    image[hit, 2] = np.linalg.norm(np.cross(normal, ray), axis=1)
    return image
