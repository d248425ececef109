"""Signals on an icosphere: directions of its vertices and faces, and values between them.

Icospheres are not normalized between subdivisions. Here their vertices are unit vectors, and a face
is the planar triangle of its three unit vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError, width_height
from tangent_train.geometry.icosphere import icosphere

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

IcosphereElements = Literal["vertices", "faces"]
"""A signal has a value at every vertex or on every face."""

_CHUNK = 2**16
"""Number of directions that are located at once."""

_KEPT = 2
"""Number of signals whose sampling points are kept in memory; 190 MB each at level 8."""


def icosphere_count(level: int, elements: IcosphereElements = "vertices") -> int:
    """Return the number of values of a signal.

    >>> icosphere_count(5), icosphere_count(5, "faces")
    (10242, 20480)
    """
    return 10 * 4**level + 2 if elements == "vertices" else 20 * 4**level


def check_signal(shape: Sequence[int], count: int) -> None:
    """Refuse the input of a network that is not a signal of its icosphere.

    Args:
        shape: Shape of the input, ``(..., 1, V)`` for V values.
        count: Number V of values that the network expects.

    Raises:
        SettingError: The input is another image or signal.
    """
    if tuple(shape[-2:]) != (1, count):
        raise SettingError(
            "input of the network",
            found=f"an image of {width_height(shape[-2:])}",
            expected=f"a signal of {count} values, an image of {width_height((1, count))}",
            remedy="Set representation=icosphere, with this level and representation.elements.",
        )


@lru_cache(maxsize=4)
def icosphere_directions(
    level: int, elements: IcosphereElements = "vertices"
) -> NDArray[np.float64]:
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


def nearest_vertices(level: int, directions_xyz: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the vertex ``(P,)`` nearest to each direction ``(P, 3)``, a unit vector."""
    return np.asarray(_vertex_tree(level).query(directions_xyz)[1], np.int64)


def locate(
    level: int, directions_xyz: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
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


class SamplingPoints(NamedTuple):
    """Points in the cells of a signal.

    Attributes:
        directions: ``(P, 3)`` unit vectors, float32.
        source: ``(T, V)`` int64, the points in each cell; point 0 with weight 0 where a cell has
            fewer than T.
        weight: ``(T, V)`` float32 weights of the points, which sum to 1.
    """

    directions: NDArray[np.float32]
    source: NDArray[np.int64]
    weight: NDArray[np.float32]


@lru_cache(maxsize=_KEPT)
def sampling_points(level: int, elements: IcosphereElements = "vertices") -> SamplingPoints:
    """Return points at which an image is averaged over each cell, weighted by solid angle.

    The three medians divide a face into six triangles of nearly equal area, with a point in the
    middle of each. The cell of a face is the face: 6 points. The cell of a vertex consists of the
    two triangles at it in each of its faces: 12 points, 10 at the 12 corners.

    Args:
        level: Level s, 0 to 8.
        elements: ``vertices`` or ``faces``.
    """
    faces = icosphere(level).faces
    corners = icosphere_directions(level)[faces]
    center = corners.mean(axis=1)
    points, areas = np.empty((len(faces), 3, 2, 3), np.float32), np.empty((len(faces), 3, 2))
    for corner in range(3):
        for side, other in enumerate((corner + 1, corner + 2)):
            a = corners[:, corner]
            middle = (a + corners[:, other % 3]) / 2
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
    return SamplingPoints(points.reshape(-1, 3), source, weight)
