"""Meshes in OFF files, such as ModelNet40's, and their spherical images.

The recipe is that of Cohen et al., Spherical CNNs (2018), which the paper follows. A mesh is moved
so that the centroid of its surface is at the origin, and scaled to reach to `RADIUS`. For every
pixel of an equirectangular image, a ray goes from its point on the unit sphere inward through the
origin. Three channels describe its first hit, three more that of the convex hull
of the mesh:

==== ============================================== ==========
0, 3 distance t from the unit sphere                1 if none
1, 4 ``|n·r|``: n the normal there, r the direction 0 if none
2, 5 ``|n×r|``                                      0 if none
==== ============================================== ==========

The axes of the mesh are those of the panorama: z is up, and the y axis is in the middle of its
right half. So the image shows the mesh as it is seen from outside, and not mirrored.
"""

from __future__ import annotations

import re
from io import StringIO
from pathlib import Path

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from trimesh import Trimesh
from trimesh.exchange.off import load_off

from tangent_train.errors import DataError
from tangent_train.geometry import equirect_directions

CHANNELS = 6
"""Three channels of the mesh, then three of its convex hull."""

RADIUS = 0.99
"""Distance of the farthest vertex from the origin."""

_DIGITS = 6
"""Number of decimals, relative to the longest extent, to which merged vertices agree."""

_LEAST_HEIGHT = 1e-8
"""Smallest height of a triangle, relative to the longest extent; lower ones are dropped."""


def read_mesh(path: Path) -> Trimesh:
    """Read a mesh with trimesh's OFF loader, and clean it; polygons become triangles.

    Raises:
        DataError: The file cannot be read, is not an OFF file, is truncated or has no surface.
    """
    try:
        text = re.sub("#.*", "", path.read_text(encoding="latin-1"))
        mesh = Trimesh(**load_off(StringIO(text)), process=False)
        # The loader accepts files that end within the faces, and NaN coordinates.
        count = int(re.findall(r"\d+", text)[1])
        if count > len(mesh.faces) or not np.isfinite(mesh.vertices).all():
            raise ValueError(f"{len(mesh.faces)} faces instead of {count}, or NaN")  # noqa: TRY301
        return clean_mesh(mesh)
    # The loader raises anything from ValueError to IndexError for broken files.
    except Exception as error:
        expected, remedy = "a surface in OFF format", "Copy or extract it again."
        raise DataError(path, found=error, expected=expected, remedy=remedy) from error


def clean_mesh(mesh: Trimesh) -> Trimesh:
    """Remove duplicates and degenerate triangles, and center the mesh in the unit sphere.

    The centroid of the surface, which need not be closed, is moved to the origin, and the mesh is
    scaled to `RADIUS`.
    """
    low, high = mesh.bounds
    extent = float(np.max(high - low)) or 1.0
    clean = Trimesh((mesh.vertices - low) / extent, mesh.faces, process=False)
    clean.merge_vertices(digits_vertex=_DIGITS)
    clean.update_faces(clean.nondegenerate_faces(height=_LEAST_HEIGHT) & clean.unique_faces())
    clean.remove_unreferenced_vertices()
    vertices = clean.vertices - clean.centroid
    vertices *= RADIUS / np.linalg.norm(vertices, axis=1).max()
    return Trimesh(vertices, clean.faces, process=False)


def mesh_spheres(mesh: Trimesh, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the spherical images of a mesh and of its convex hull.

    A flat mesh counts as its own hull.

    Args:
        mesh: From `clean_mesh`.
        shape: ``(H, W)`` of the equirectangular images.

    Returns:
        ``(H, W, 6)`` channels; distances are below 2, the others at most 1.
    """
    directions = equirect_directions(shape).reshape(-1, 3)
    try:
        hull = Trimesh(mesh.vertices, ConvexHull(mesh.vertices).simplices, process=False)
    except QhullError:
        hull = mesh
    images = [_cast(surface, directions) for surface in (mesh, hull)]
    return np.concatenate(images, axis=1).reshape(*shape, CHANNELS)


def _cast(mesh: Trimesh, directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return distance, ``|n·r|`` and ``|n×r|`` of first hits of rays inward, ``(n, 3)``."""
    # Robust: no ray slips through between two triangles that share an edge.
    tree = EmbreeScene(robust=True)
    _keep = TriangleMesh(tree, mesh.triangles.astype(np.float32))
    origins = directions.astype(np.float32)
    answer = tree.run(origins, -origins, query="INTERSECT", output=1)
    hit = np.flatnonzero(answer["primID"] >= 0)
    corners = mesh.triangles[answer["primID"][hit]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    image = np.zeros((len(directions), 3))
    image[:, 0] = 1
    image[hit, 0] = answer["tfar"][hit]
    image[hit, 1] = np.abs(np.einsum("ij,ij->i", normal, directions[hit]))
    image[hit, 2] = np.linalg.norm(np.cross(normal, directions[hit]), axis=1)
    return image
