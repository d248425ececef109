"""Cells of directions on the sphere: each belongs to the nearest of some centers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def cell_neighbors(centers_xyz: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the neighbors of every cell.

    They are the edges of the convex hull of the centers. A linear function that is not the largest
    at a corner of a convex body increases along one of its edges, so stepping repeatedly to the
    neighbor with the nearest center ends at the nearest one. If the centers lie in a plane, all
    others are neighbors.

    Args:
        centers_xyz: ``(N, 3)`` different unit vectors.

    Returns:
        ``(N, k)`` indices, padded with the cell itself.
    """
    hull, count = _hull(centers_xyz), len(centers_xyz)
    if hull is None:
        pairs = np.argwhere(~np.eye(count, dtype=np.bool_))
    else:
        sides = hull[0][:, [[0, 1], [1, 2], [2, 0], [1, 0], [2, 1], [0, 2]]]
        pairs = np.unique(sides.reshape(-1, 2), axis=0)
    cells, others = pairs.T
    number = np.arange(len(cells)) - np.searchsorted(cells, cells)
    neighbors = np.repeat(np.arange(count)[:, None], 1 + number.max(initial=0), axis=1)
    neighbors[cells, number] = others
    return neighbors.astype(np.int32)


def cell_borders(
    centers_xyz: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the borders of the cells, which are arcs of great circles.

    The corners of the cells are the normals of the faces of the convex hull of the centers.

    Args:
        centers_xyz: ``(N, 3)`` different unit vectors.

    Returns:
        ``(n,)`` cells, ``(n, 3)`` first ends of their borders and ``(n, 3)`` middles, unit vectors;
        None if the centers lie in a plane.
    """
    hull = _hull(centers_xyz)
    if hull is None:
        return None
    faces, normals, adjacent = hull
    # The border opposite to corner k of a face is shared by cells k + 1 and k + 2.
    ends, others = np.repeat(normals, 3, axis=0), normals[adjacent.ravel()]
    is_arc = np.linalg.norm(ends - others, axis=1) > 1e-9  # not inside a face of four corners
    middles = ends + others
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    cells = np.concatenate([np.roll(faces, -k, axis=1).ravel()[is_arc] for k in (1, 2)])
    return cells, np.tile(ends[is_arc], (2, 1)), np.tile(middles[is_arc], (2, 1))


def _hull(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]] | None:
    """Return corners, normals and adjacent faces of the convex hull; None for points in a plane."""
    from scipy.spatial import ConvexHull, QhullError  # slow to import

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):
        return None
    return hull.simplices.astype(np.int64), hull.equations[:, :3], hull.neighbors.astype(np.int64)
