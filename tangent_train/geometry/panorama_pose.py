"""Poses of panoramas: position and orientation."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.geometry.sphere import checked_rotation


class PanoramaPose:
    """Pose of a panorama in a world frame in meters.

    A point at distance d in direction s of the panorama (`tangent_train.geometry`: x to the middle
    of the image, y to its right, z up) is ``location_m + d · world_from_panorama @ s``.

    In a right-handed world the determinant is −1, see `to_right_handed`.

    Args:
        world_from_panorama: ``(3, 3)`` orthogonal matrix of determinant 1 or −1.
        location_m: ``(3,)`` position of the center.

    Raises:
        SettingError: The matrix is not orthogonal.
    """

    def __init__(self, world_from_panorama: ArrayLike, location_m: ArrayLike) -> None:
        self.world_from_panorama = np.array(world_from_panorama, np.float64)
        self.location_m = np.array(location_m, np.float64)
        is_mirrored = np.linalg.det(self.world_from_panorama) < 0
        checked_rotation(-self.world_from_panorama if is_mirrored else self.world_from_panorama)

    def points_m(self, directions_xyz: ArrayLike, distance_m: ArrayLike) -> NDArray[np.float64]:
        """Return world points ``(…, 3)`` in directions ``(…, 3)`` at distances ``(…)``."""
        ahead = np.asarray(directions_xyz, np.float64) @ self.world_from_panorama.T
        return self.location_m + ahead * np.asarray(distance_m, np.float64)[..., None]

    def project(self, points_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return directions ``(…, 3)`` and distances ``(…)`` in meters of world points ``(…, 3)``.

        A point at the center itself has the direction 0.
        """
        offset = (np.asarray(points_m, np.float64) - self.location_m) @ self.world_from_panorama
        distance = np.linalg.norm(offset, axis=-1)
        return offset / np.where(distance > 0, distance, 1.0)[..., None], distance

    def relative_to(self, other: PanoramaPose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return rotation and shift from another panorama to this one: ``x_this = R x_other + t``.

        Args:
            other: Pose in the same world.

        Returns:
            R ``(3, 3)``, a rotation, and t ``(3,)`` in meters: the position of the other's center.
        """
        rotation = self.world_from_panorama.T @ other.world_from_panorama
        return rotation, (other.location_m - self.location_m) @ self.world_from_panorama
