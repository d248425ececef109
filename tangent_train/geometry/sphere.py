"""Directions, longitude and latitude, rotations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError


def lonlat_to_xyz(lonlat_rad: ArrayLike) -> NDArray[np.float64]:
    """Return unit vectors of longitudes and latitudes.

    Args:
        lonlat_rad: ``(..., 2)`` longitude λ and latitude φ in radians.

    Returns:
        ``(..., 3)`` directions.

    >>> lonlat_to_xyz([np.pi / 2, 0.0]).round(6).tolist()
    [0.0, 1.0, 0.0]
    """
    lon, lat = np.moveaxis(np.asarray(lonlat_rad, np.float64), -1, 0)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def xyz_to_lonlat(directions_xyz: ArrayLike) -> NDArray[np.float64]:
    """Return longitude in [−π, π] and latitude of directions; inverse of `lonlat_to_xyz`.

    Args:
        directions_xyz: ``(..., 3)`` non-zero vectors of any length.

    Returns:
        ``(..., 2)`` radians.
    """
    x, y, z = np.moveaxis(np.asarray(directions_xyz, np.float64), -1, 0)
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1)


def to_right_handed(vectors_xyz: ArrayLike) -> NDArray[np.float64]:
    """Return vectors of the sphere's frame, y to the right, with y to the left, and back.

    All files have the result's frame: point clouds, poses and cameras. Of a matrix that maps
    vectors of the one frame, it returns the matrix that maps those of the other.

    Args:
        vectors_xyz: ``(..., 3)`` vectors.
    """
    return np.asarray(np.asarray(vectors_xyz, np.float64) @ np.diag([1.0, -1.0, 1.0]))


def rotation_about(axis_xyz: ArrayLike, angle_rad: float) -> NDArray[np.float64]:
    """Return the rotation by an angle about an axis (Rodrigues' formula).

    Args:
        axis_xyz: ``(3,)`` axis of any length. About ``(0, 0, 1)`` a positive angle adds to λ.
        angle_rad: Angle in radians.

    Returns:
        ``(3, 3)`` rotation matrix, to be multiplied from the left.
    """
    x, y, z = np.asarray(axis_xyz, np.float64) / np.linalg.norm(axis_xyz)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * (cross @ cross)


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a rotation uniformly from SO(3) (a uniform unit quaternion).

    Args:
        rng: Source of randomness.

    Returns:
        ``(3, 3)`` rotation matrix.
    """
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def checked_rotation(rotation: ArrayLike) -> NDArray[np.float64]:
    """Return a read-only copy of a rotation matrix.

    Args:
        rotation: ``(3, 3)`` matrix.

    Raises:
        SettingError: The matrix is not a proper rotation.
    """
    matrix = np.array(rotation, np.float64)
    proper = matrix.shape == (3, 3) and np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6)
    if not proper or np.linalg.det(matrix) < 0:
        raise SettingError(
            "rotation", found=matrix.tolist(), expected="a 3×3 rotation matrix of determinant +1"
        )
    matrix.setflags(write=False)
    return matrix
