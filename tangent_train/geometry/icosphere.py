"""Icosahedron with vertices at both poles, its Loop subdivisions, and signals on them.

The vertices of `icosphere` are not normalized between subdivisions. Signals have values in the
directions of vertices, unit vectors, or on faces: the planar triangles of three unit vectors.
"""

from __future__ import annotations

from functools import cache, lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import at_least
from tangent_train.geometry.sphere import Floats, lonlat_to_xyz

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

IcosphereElements = Literal["vertices", "faces"]
"""A signal has a value at every vertex or on every face."""

_CHUNK = 2**16
"""Number of directions that are located at once."""

_KEPT = 2
"""Number of signals whose sampling points are kept in memory; 190 MB each at level 8."""


class Icosphere(NamedTuple):
    """A triangle mesh.

    Attributes:
        vertices: ``(V, 3)`` float64, not normalized: only their directions matter.
        faces: ``(F, 3)`` int64 vertex indices, all of one winding.
    """

    vertices: Floats
    faces: NDArray[np.int64]


def _icosahedron() -> Icosphere:
    """Return two poles and two rings of five vertices at latitudes ±atan ½."""
    k, steps = np.arange(10), 2 * np.pi / 5 * np.array([0, 1, 2, 3, 4, 0.5, 1.5, 2.5, 3.5, 4.5])
    rings = lonlat_to_xyz(np.stack([steps, np.arctan(0.5) * np.where(k < 5, 1, -1)], axis=-1))
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], rings, [[0.0, 0.0, -1.0]]])
    upper, lower = 1 + k[:5], 6 + k[:5]
    upper_next, lower_next = np.roll(upper, -1), np.roll(lower, -1)
    north, south = np.zeros(5, np.int64), np.full(5, 11)
    triangles = [
        (north, upper, upper_next),
        (upper, lower, upper_next),
        (upper_next, lower, lower_next),
        (south, lower_next, lower),
    ]
    return Icosphere(vertices, np.concatenate([np.stack(t, axis=-1) for t in triangles]))


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


@cache
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
    at_least("level of the icosphere", level, 0, 8)
    mesh = _icosahedron() if level == 0 else _subdivide(icosphere(level - 1))
    for array in mesh:
        array.setflags(write=False)
    return mesh


@cache
def vertex_resolution(base_level: int) -> float:
    """Return R_v: the mean over vertices of the mean angle to their neighbors (section 3.2).

    Args:
        base_level: Level b, −1 to 8; R_v(−1) is defined as 2 R_v(0).

    Returns:
        Radians.

    >>> round(vertex_resolution(0), 7)
    1.1071487
    """
    if base_level == -1:
        return 2 * vertex_resolution(0)
    edges, _ = _edges(icosphere(base_level).faces)
    a, b = np.moveaxis(icosphere_directions(base_level)[edges], 1, 0)
    angles = 2 * np.arcsin(np.linalg.norm(a - b, axis=1) / 2)
    total = np.bincount(edges.ravel(), np.repeat(angles, 2))
    return float(np.mean(total / np.bincount(edges.ravel())))


def icosphere_count(level: int, elements: IcosphereElements = "vertices") -> int:
    """Return the number of values of a signal.

    >>> icosphere_count(5), icosphere_count(5, "faces")
    (10242, 20480)
    """
    return 10 * 4**level + 2 if elements == "vertices" else 20 * 4**level


@lru_cache(maxsize=4)
def icosphere_directions(level: int, elements: IcosphereElements = "vertices") -> Floats:
    """Return the directions of the vertices or of the faces' centers.

    The order is that of `icosphere`: the first vertices are those of the level below, and the
    children of face f are 4f … 4f+3.

    Args:
        level: Level s, 0 to 8.
        elements: ``vertices`` or ``faces``.

    Returns:
        ``(V, 3)`` unit vectors, read-only.
    """
    vertices, faces = icosphere(level)
    if elements == "faces":
        vertices = icosphere_directions(level)[faces].mean(axis=1)
    directions = vertices / np.linalg.norm(vertices, axis=-1, keepdims=True)
    directions.setflags(write=False)
    return directions


@lru_cache(maxsize=4)
def faces_of_vertices(level: int) -> NDArray[np.int64]:
    """Return ``(V, 6)`` faces that meet at each vertex; −1 for the sixth at the 12 corners."""
    faces = icosphere(level).faces
    corners = faces.ravel().argsort(kind="stable")
    counts = np.bincount(faces.ravel())
    around = np.full((len(counts), 6), -1)
    around[np.arange(6) < counts[:, None]] = corners // 3
    around.setflags(write=False)
    return around


@lru_cache(maxsize=2)
def _vertex_tree(level: int) -> cKDTree:
    from scipy.spatial import cKDTree  # slow to import

    return cKDTree(icosphere_directions(level))


def nearest_vertices(level: int, directions_xyz: Floats) -> NDArray[np.int64]:
    """Return the vertex ``(P,)`` nearest to each direction ``(P, 3)``, a unit vector."""
    return np.asarray(_vertex_tree(level).query(directions_xyz)[1], np.int64)


def locate(level: int, directions_xyz: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Find the face that contains each direction, and barycentric weights of its vertices.

    Linear interpolation of values v at the vertices is ``(weights * v[faces[found]]).sum(1)``. As
    all angles are acute, the face is one of those at the nearest vertex.

    Args:
        level: Level s, 0 to 8.
        directions_xyz: ``(P, 3)`` unit vectors.

    Returns:
        ``(P,)`` faces and ``(P, 3)`` weights of their vertices, 0 or more, which sum to 1. On an
        edge, any of its faces is returned.
    """
    around = faces_of_vertices(level)
    a, b, c = np.moveaxis(icosphere_directions(level)[icosphere(level).faces], 1, 0)
    normals = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    found = np.empty(len(directions_xyz), np.int64)
    weights = np.empty((len(directions_xyz), 3))
    for start in range(0, len(found), _CHUNK):
        points = directions_xyz[start : start + _CHUNK]
        candidates = around[nearest_vertices(level, points)]
        candidates = np.where(candidates < 0, candidates[:, :1], candidates)
        shares = (normals[candidates] @ points[:, None, :, None])[..., 0]
        shares /= shares.sum(axis=2, keepdims=True)
        best = shares.min(axis=2).argmax(axis=1)[:, None]
        found[start : start + _CHUNK] = np.take_along_axis(candidates, best, 1)[:, 0]
        chosen = np.take_along_axis(shares, best[..., None], 1)[:, 0].clip(0)
        weights[start : start + _CHUNK] = chosen / chosen.sum(axis=1, keepdims=True)
    return found, weights


@lru_cache(maxsize=_KEPT)
def sampling_points(
    level: int, elements: IcosphereElements = "vertices"
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32]]:
    """Return points at which an image is averaged over each cell, weighted by solid angle.

    The three medians divide a face into six triangles of nearly equal area, with a point in the
    middle of each. The cell of a face is the face: 6 points. The cell of a vertex consists of the
    two triangles at it in each of its faces: 12 points, 10 at the 12 corners.

    Args:
        level: Level s, 0 to 8.
        elements: ``vertices`` or ``faces``.

    Returns:
        Directions ``(P, 3)`` of the points; the points ``(T, V)`` in each cell, point 0 where a
        cell has fewer than T; and their weights ``(T, V)``, which sum to 1, 0 for these.
    """
    faces = icosphere(level).faces
    corners = icosphere_directions(level)[faces]
    center = corners.mean(axis=1)
    points, areas = np.empty((len(faces), 3, 2, 3), np.float32), np.empty((len(faces), 3, 2))
    for corner, side in np.ndindex(3, 2):
        a = corners[:, corner]
        middle = (a + corners[:, (corner + 1 + side) % 3]) / 2
        point = (a + middle + center) / 3
        length = np.linalg.norm(point, axis=1, keepdims=True)
        points[:, corner, side] = point / length
        # The solid angle of a small triangle: twice its area, seen from its middle.
        volume = np.abs(np.einsum("pc,pc->p", a, np.cross(middle, center)))
        areas[:, corner, side] = volume / length[:, 0] ** 3
    cells = np.arange(len(faces))[:, None] if elements == "faces" else faces
    cell = np.broadcast_to(cells[..., None], areas.shape).ravel()
    order, counts = cell.argsort(kind="stable"), np.bincount(cell)
    slots = np.arange(len(cell)) - (counts.cumsum() - counts).repeat(counts)
    source = np.zeros((counts.max(), len(counts)), np.int64)
    weight = np.zeros(source.shape, np.float32)
    source[slots, cell[order]] = order
    weight[slots, cell[order]] = (areas.ravel() / np.bincount(cell, areas.ravel())[cell])[order]
    return points.reshape(-1, 3), source, weight
