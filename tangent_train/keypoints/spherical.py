"""Keypoints as directions, and their places in a panorama."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from tangent_train.errors import SettingError
from tangent_train.geometry import checked_rotation, lonlat_to_equirect, xyz_to_lonlat

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

__all__ = ["SphericalKeypoints", "angles_between", "unit_directions"]


@dataclass(frozen=True, eq=False)
class SphericalKeypoints:
    """n keypoints in the frame of `tangent_train.geometry`, whatever they were found in.

    Sizes and orientations are OpenCV's, taken from the image to the sphere at the keypoint: the
    size by the square root of the map's area factor, the orientation as a gradient (see
    `local_to_sphere`). Descriptors describe the image they were computed in.

    Attributes:
        directions_xyz: ``(n, 3)`` float64 unit vectors.
        sizes_rad: ``(n,)`` float32, angular diameter of OpenCV's neighbourhood (``KeyPoint.size``).
        orientations_xyz: ``(n, 3)`` float64 unit vectors, each perpendicular to its direction.
        responses: ``(n,)`` float32 strength, comparable among keypoints of one detector.
        descriptors: ``(n, D)`` float32 (compared by Euclidean distance) or uint8 (bits, Hamming
            distance).
        images: ``(n,)`` int32, the face each was found in; 0 for a panorama.

    Raises:
        SettingError: The arrays do not belong together.
    """

    directions_xyz: NDArray[np.float64]
    sizes_rad: NDArray[np.float32]
    orientations_xyz: NDArray[np.float64]
    responses: NDArray[np.float32]
    descriptors: NDArray[np.float32] | NDArray[np.uint8]
    images: NDArray[np.int32]

    def __post_init__(self) -> None:
        n = self.directions_xyz.shape[:1]
        expected = [(*n, 3), n, (*n, 3), n, (*n, *self.descriptors.shape[1:2]), n]
        found = [values.shape for values in self._arrays()]
        if found != expected:
            raise SettingError("keypoints", found=f"shapes {found}", expected=f"{expected}")

    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return tuple(getattr(self, field.name) for field in fields(self))

    def __len__(self) -> int:
        return len(self.directions_xyz)

    @classmethod
    def concatenated(cls, parts: Sequence[SphericalKeypoints]) -> Self:
        """All keypoints of one or more parts, found by one detector, in their order."""
        columns = zip(*(part._arrays() for part in parts), strict=True)
        return cls(*(np.concatenate(column) for column in columns))

    def select(self, chosen: ArrayLike) -> Self:
        """Some of the keypoints.

        Args:
            chosen: ``(n,)`` bool, or indices in any order.
        """
        index = np.asarray(chosen)
        if index.size == 0 and index.dtype != np.bool_:
            index = index.astype(np.int64)  # an empty list is float64
        return type(self)(*(values[index] for values in self._arrays()))

    def turned(self, rotation: ArrayLike) -> Self:
        """The keypoints of the panorama turned by R, as `rotate_equirect` turns it.

        Args:
            rotation: ``(3, 3)`` rotation R: directions and orientations become R·d.

        Raises:
            SettingError: The rotation is none.
        """
        matrix = checked_rotation(rotation)
        directions, orientations = (
            vectors @ matrix.T for vectors in (self.directions_xyz, self.orientations_xyz)
        )
        return type(self)(
            directions,
            self.sizes_rad,
            orientations,
            self.responses,
            self.descriptors,
            self.images,
        )

    def equirect_pixels(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Places in a panorama.

        Args:
            shape: ``(H, W)`` of any panorama of the same frame.

        Returns:
            ``(n, 2)`` column in [−½, W − ½] and row in [−½, H − ½]; pixel centres are integers.
        """
        return lonlat_to_equirect(xyz_to_lonlat(self.directions_xyz), shape)

    def equirect_sizes(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """``(n,)`` diameters in pixels of discs of the same area in a panorama ``(H, W)``.

        Near the poles, where a panorama is stretched without bound, no larger than its height.
        """
        columns, rows = np.moveaxis(equirect_jacobian(self.directions_xyz, shape), -1, 0)
        area = np.linalg.norm(np.cross(columns, rows), axis=-1)
        return np.minimum(self.sizes_rad / np.sqrt(np.maximum(area, 1e-30)), shape[0])

    def equirect_angles(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """``(n,)`` orientations in a panorama ``(H, W)``, radians from right towards down."""
        jacobian = equirect_jacobian(self.directions_xyz, shape)
        gradient = np.einsum("nc,nci->ni", self.orientations_xyz, jacobian)
        return np.arctan2(gradient[:, 1], gradient[:, 0])


def unit_directions(directions_xyz: ArrayLike) -> NDArray[np.float64]:
    """Directions of any length, made unit vectors.

    Args:
        directions_xyz: ``(n, 3)``, of any length but 0.

    Raises:
        SettingError: They have another shape, are 0 or no numbers.
    """
    array = np.asarray(directions_xyz, np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise SettingError("directions", found=f"shape {array.shape}", expected="(n, 3)")
    lengths = np.linalg.norm(array, axis=1, keepdims=True)
    if not (np.isfinite(lengths) & (lengths > 0)).all():
        raise SettingError(
            "directions", found="some that are 0 or no numbers", expected="finite vectors"
        )
    return array / lengths


def angles_between(first_xyz: ArrayLike, second_xyz: ArrayLike) -> NDArray[np.float64]:
    """Angles between unit vectors in radians, precise near 0 and π alike.

    Args:
        first_xyz: ``(..., 3)``.
        second_xyz: ``(..., 3)``.

    Returns:
        ``(...)`` from 0 to π.
    """
    first, second = np.asarray(first_xyz, np.float64), np.asarray(second_xyz, np.float64)
    halves = (np.linalg.norm(first + sign * second, axis=-1) for sign in (-1, 1))
    return np.asarray(2 * np.arctan2(*halves))


def equirect_jacobian(
    directions_xyz: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.float64]:
    """How directions move with their pixel in a panorama: ``∂d/∂(u, v)``.

    With east e = (−sin λ, cos λ, 0) and north n: ``∂d/∂u = 2π/W · cos φ · e``,
    ``∂d/∂v = −π/H · n``. The area factor is ``2π²/(W·H) · cos φ``.

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
    jacobian: NDArray[np.float64], sizes: NDArray[np.floating], angles_rad: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Sizes and orientations of keypoints from the image they were found in to the sphere.

    A disc of the image becomes an ellipse on the sphere; the size given is the diameter of the disc
    of its area: ``size · √|∂d/∂u × ∂d/∂v|``. The orientation of a keypoint is the mean direction of
    the grey values' gradient around it (the intensity centroid of ORB is one, too, by the
    divergence theorem). A gradient is no displacement: where the map stretches the image, it turns
    towards the direction that is stretched less. With the Jacobian J (3×2) it becomes
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
    angles = np.asarray(angles_rad, np.float64)
    gradient = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    metric = np.einsum("nci,ncj->nij", jacobian, jacobian)
    pushed = np.linalg.solve(metric, gradient[..., None])[..., 0]
    vectors = np.einsum("nci,ni->nc", jacobian, pushed)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (sizes * np.sqrt(area)).astype(np.float32), vectors
