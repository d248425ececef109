"""Sampling points of distortion-aware convolutions: grids on the tangent planes of directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.geometry.sphere import xyz_to_lonlat


def tangent_axes(directions_xyz: ArrayLike) -> NDArray[np.float64]:
    """Return east, north and the unit vector itself of each direction.

    Both poles have longitude 0: y points to the east of either.

    Args:
        directions_xyz: ``(..., 3)`` non-zero vectors of any length.

    Returns:
        ``(..., 3, 3)`` unit vectors as rows.
    """
    xyz = np.asarray(directions_xyz, np.float64)
    xyz = xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)
    lon, lat = np.moveaxis(xyz_to_lonlat(xyz), -1, 0)
    lon = np.where(np.hypot(xyz[..., 0], xyz[..., 1]) < 1e-9, 0.0, lon)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    return np.stack([east, north, xyz], axis=-2)


def gnomonic_points_xyz(
    directions_xyz: ArrayLike, kernel: int | tuple[int, int], pitch: float
) -> NDArray[np.float64]:
    """Return where a convolution samples the sphere (Coors et al. 2018, Tateno et al. 2018).

    The points of a direction form a grid on its tangent plane, aligned to north: the inverse
    gnomonic projection. They are in the order of a convolution's weight on an image: rows from
    north to south, columns from west to east.

    Args:
        directions_xyz: ``(P, 3)`` non-zero vectors of any length.
        kernel: Rows and columns of the grid; one number for both.
        pitch: Distance of neighboring points on the tangent plane of the unit sphere.

    Returns:
        ``(P, rows · columns, 3)`` unit vectors.

    >>> gnomonic_points_xyz([[1.0, 0.0, 0.0]], 3, 1.0)[0, [1, 5]].round(4).tolist()
    [[0.7071, 0.0, 0.7071], [0.7071, 0.7071, 0.0]]
    """
    rows, columns = (kernel, kernel) if isinstance(kernel, int) else kernel
    up, right = ((np.arange(side) - (side - 1) / 2) * pitch for side in (rows, columns))
    y, x = np.meshgrid(up[::-1], right, indexing="ij")
    offsets = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    points = offsets @ tangent_axes(directions_xyz)
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))
