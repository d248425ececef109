"""Keypoints as directions on the sphere, and their positions in a panorama."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.geometry import lonlat_to_equirect, xyz_to_lonlat

Floats = NDArray[np.float64]
"""Directions, rotations and other float64 arrays."""


@dataclass(frozen=True, eq=False)
class SphericalKeypoints:
    """n keypoints in the frame of `tangent_train.geometry`.

    Sizes and orientations come from OpenCV, mapped from image to sphere (`local_to_sphere`).

    Attributes:
        directions_xyz: ``(n, 3)`` float64 unit vectors.
        sizes_rad: ``(n,)`` float32, angular diameter of the neighborhood (``KeyPoint.size``).
        orientations_xyz: ``(n, 3)`` float64 unit vectors, perpendicular to the directions.
        responses: ``(n,)`` float32 strength.
        descriptors: ``(n, D)`` float32.
        images: ``(n,)`` int32, the face in which each was detected; 0 for a panorama.
    """

    directions_xyz: Floats
    sizes_rad: NDArray[np.float32]
    orientations_xyz: Floats
    responses: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    images: NDArray[np.int32]

    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return tuple(getattr(self, field.name) for field in fields(self))

    def __len__(self) -> int:
        return len(self.directions_xyz)

    @classmethod
    def concatenated(cls, parts: Sequence[SphericalKeypoints]) -> Self:
        """Return the keypoints of one or more parts, in their order."""
        columns = zip(*(part._arrays() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.integer]) -> Self:
        """Return some of the keypoints, by a mask or by indices."""
        return type(self)(*(values[chosen] for values in self._arrays()))

    def equirect_pixels(self, shape: tuple[int, int]) -> Floats:
        """Return ``(n, 2)`` columns and rows in a panorama ``(H, W)``; centers are integers."""
        return lonlat_to_equirect(xyz_to_lonlat(self.directions_xyz), shape)


def angles_between(first_xyz: ArrayLike, second_xyz: ArrayLike) -> Floats:
    """Return ``(...)`` angles of ``(..., 3)`` unit vectors in radians, precise near 0 and π."""
    first, second = np.asarray(first_xyz, np.float64), np.asarray(second_xyz, np.float64)
    halves = (np.linalg.norm(first + sign * second, axis=-1) for sign in (-1, 1))
    return np.asarray(2 * np.arctan2(*halves))


def equirect_jacobian(directions_xyz: Floats, shape: tuple[int, int]) -> Floats:
    """Return the Jacobian of directions by pixel in a panorama, ``∂d/∂(u, v)``.

    With east e = (−sin λ, cos λ, 0) and north n: ``∂d/∂u = 2π/W · cos φ · e``,
    ``∂d/∂v = −π/H · n``.

    Args:
        directions_xyz: ``(n, 3)`` unit vectors.
        shape: ``(H, W)``.

    Returns:
        ``(n, 3, 2)``.
    """
    x, y, z = directions_xyz.T
    lon, cos_lat = np.arctan2(y, x), np.hypot(x, y)
    north = np.stack([-z * np.cos(lon), -z * np.sin(lon), cos_lat], axis=-1)
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    height, width = shape
    columns = east * (2 * np.pi / width * cos_lat)[:, None]
    return np.stack([columns, north * (-np.pi / height)], axis=-1)


def local_to_sphere(
    jacobian: Floats, sizes: NDArray[np.floating], angles_rad: NDArray[np.floating]
) -> tuple[NDArray[np.float32], Floats]:
    """Map sizes and orientations of keypoints from an image to the sphere.

    A disc in the image becomes an ellipse on the sphere. Its size is the diameter of a disc of the
    same area: ``size · √|∂d/∂u × ∂d/∂v|``. The orientation of a keypoint is the mean gradient of
    the gray values around it. A gradient is a covector: with the Jacobian J (3×2) it becomes
    ``J (JᵀJ)⁻¹ (cos a, sin a)``, scaled to length 1.

    Args:
        jacobian: ``(n, 3, 2)`` ``∂d/∂(u, v)``, tangent to the sphere, columns not parallel.
        sizes: ``(n,)`` diameters in pixels.
        angles_rad: ``(n,)`` orientations from right (u) towards down (v).

    Returns:
        ``(n,)`` sizes in radians and ``(n, 3)`` unit tangent vectors.
    """
    columns, rows = np.moveaxis(jacobian, -1, 0)
    area = np.linalg.norm(np.cross(columns, rows), axis=-1)
    gradient = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
    metric = np.einsum("nci,ncj->nij", jacobian, jacobian)
    pushed = np.linalg.solve(metric, gradient[..., None])[..., 0]
    vectors = np.einsum("nci,ni->nc", jacobian, pushed)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (sizes * np.sqrt(area)).astype(np.float32), vectors
