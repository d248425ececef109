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
    from scipy.spatial import ConvexHull, QhullError  # slow to import

    count = len(centers_xyz)
    try:
        triangles = ConvexHull(centers_xyz).simplices
        sides = triangles[:, [[0, 1], [1, 2], [2, 0], [1, 0], [2, 1], [0, 2]]]
        pairs = np.unique(sides.reshape(-1, 2), axis=0)
    except (QhullError, ValueError):
        pairs = np.argwhere(~np.eye(count, dtype=np.bool_))
    cells, others = pairs.T
    number = np.arange(len(cells)) - np.searchsorted(cells, cells)
    neighbors = np.repeat(np.arange(count)[:, None], 1 + number.max(initial=0), axis=1)
    neighbors[cells, number] = others
    return neighbors.astype(np.int32)


def cell_corners(
    centers_xyz: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the corners of the cells: the normals of the convex hull of the centers.

    Args:
        centers_xyz: ``(N, 3)`` different unit vectors around the origin.

    Returns:
        ``(n, 3)`` cells that meet at each corner, and ``(n, 3)`` corners, unit vectors.
    """
    from scipy.spatial import ConvexHull  # slow to import

    hull = ConvexHull(centers_xyz)
    return hull.simplices.astype(np.int64), hull.equations[:, :3]
