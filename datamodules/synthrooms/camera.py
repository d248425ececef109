"""Poses, panoramas and perspective views, and the rays of their pixels.

Room coordinates are right-handed, in meters, z up. Camera axes are x right, y down, z forward, as
in `tangent_train.geometry`. A pose (R, c) takes room to camera coordinates by
``x_cam = R (x − c)``; ``camera_rt_matrix`` in the pose file is ``[R | −R c]``.

A panorama's pose is that of an upright camera facing the middle of the panorama. Its pixel
with sphere direction s (`tangent_train.geometry`: x to the middle, y right, z up) and distance d is
the room's point ``c + d Rᵀ (s_y, −s_z, s_x)``, which is ``c + d Rz(ψ) to_right_handed(s)`` with
the heading ψ counterclockwise from the room's x axis. A perspective pixel (column j, row i)
with z-depth d is
``c + d Rᵀ K⁻¹ (j, i, 1)`` with K for integer pixel centers.

Angles in pose files are Blender's XYZ Euler angles of a camera facing its −z with +y up:
``Rᵀ = Rz(c) Ry(b) Rx(a) diag(1, −1, −1)`` (as in the real set).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import (
    camera_matrix_from_fov,
    equirect_latitudes,
    equirect_longitudes,
    lonlat_to_xyz,
    perspective_directions,
    rotation_about,
)

ViewKind = Literal["stanford", "wide", "uniform"]
"""Viewing directions of photos, see `RoomSettings.views`."""

_X, _Y, _Z = np.eye(3)
_BLENDER = np.diag([1.0, -1.0, -1.0])  # Blender's camera axes <-> x right, y down, z forward
CAMERA_FROM_SPHERE = np.array([[0, 1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])
"""A panorama's axes (x to the middle, y right, z up) to a camera's (x right, y down, z forward)."""


def euler_rotation(angles_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``Rz(c) Ry(b) Rx(a)`` of XYZ Euler angles (a, b, c)."""
    a, b, c = angles_rad
    return rotation_about(_Z, c) @ rotation_about(_Y, b) @ rotation_about(_X, a)


def euler_angles(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return XYZ Euler angles in radians; inverse of `euler_rotation` with b in [−π/2, π/2]."""
    b = math.asin(np.clip(-rotation[2, 0], -1, 1))
    if abs(rotation[2, 0]) > 1 - 1e-12:  # a and c rotate about the same axis: give all to c
        return np.array([0, b, math.atan2(-rotation[0, 1], rotation[1, 1])])
    a = math.atan2(rotation[2, 1], rotation[2, 2])
    return np.array([a, b, math.atan2(rotation[1, 0], rotation[0, 0])])


@dataclass(frozen=True)
class Pose:
    """Position and orientation of a camera.

    Attributes:
        location: ``(3,)`` center in meters.
        world_from_camera: ``(3, 3)`` Rᵀ; its columns are the camera's right, down and forward.
    """

    location: NDArray[np.float64]
    world_from_camera: NDArray[np.float64]

    @classmethod
    def looking(
        cls, location: NDArray[np.float64], heading: float, pitch: float = 0.0, roll: float = 0.0
    ) -> Pose:
        """Return the pose for some angles in radians.

        Args:
            location: ``(3,)`` center in meters.
            heading: Counterclockwise from the room's x axis, seen from above.
            pitch: Upward tilt.
            roll: Clockwise as seen by the camera; the picture tilts counterclockwise.
        """
        upright = rotation_about(_Z, heading - math.pi / 2) @ rotation_about(
            _X, math.pi / 2 + pitch
        )
        return cls(location, upright @ rotation_about(_Z, -roll) @ _BLENDER)

    @property
    def euler_angles(self) -> NDArray[np.float64]:
        """XYZ Euler angles of Blender's camera, as in pose files."""
        return euler_angles(self.world_from_camera @ _BLENDER)

    @property
    def rt_matrix(self) -> NDArray[np.float64]:
        """``(3, 4)`` matrix from room to camera coordinates."""
        rotation = self.world_from_camera.T
        return np.hstack([rotation, -(rotation @ self.location)[:, None]])


@dataclass(frozen=True)
class PanoramaRays:
    """A panorama of ``height × 2 height`` pixels; its depth is the distance."""

    pose: Pose
    height: int

    def rays(self, dx: float = 0.0, dy: float = 0.0) -> NDArray[np.float32]:
        """Return the room directions of all pixels, shifted by (dx, dy) pixels: ``(h, w, 3)``."""
        lon = equirect_longitudes(2 * self.height, dx)
        lat = equirect_latitudes(self.height, dy)
        # A direction is cos φ times its horizontal part plus the vertical: no trigonometry here.
        room_from_sphere = (self.pose.world_from_camera @ CAMERA_FROM_SPHERE).T
        level = (lonlat_to_xyz(np.stack([lon, 0 * lon], axis=-1)) @ room_from_sphere).astype(
            np.float32
        )
        vertical = np.sin(lat)[:, None] * room_from_sphere[2]
        spread = np.cos(lat).astype(np.float32)[:, None, None] * level
        return spread + vertical.astype(np.float32)[:, None, :]

    def depth_m(self, distance_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the depth ``(h, w)`` of distances along all rays: the distance itself."""
        return distance_m


@dataclass(frozen=True)
class PerspectiveRays:
    """A square pinhole image; its depth is the z-depth.

    Attributes:
        pose: Pose of the camera.
        size: Side in pixels.
        fov_rad: Field of view between the outer pixel edges.
    """

    pose: Pose
    size: int
    fov_rad: float

    @property
    def camera_matrix(self) -> NDArray[np.float64]:
        """``(3, 3)`` K for integer pixel centers."""
        return camera_matrix_from_fov(math.degrees(self.fov_rad), (self.size, self.size))

    def rays(self, dx: float = 0.0, dy: float = 0.0) -> NDArray[np.float32]:
        """Return the room directions of all pixels, shifted by (dx, dy) pixels: ``(h, w, 3)``."""
        moved = self.camera_matrix
        moved[:2, 2] -= (dx, dy)
        directions = perspective_directions(moved, (self.size, self.size)).astype(np.float32)
        return directions @ self.pose.world_from_camera.T.astype(np.float32)

    def depth_m(self, distance_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the depth ``(h, w)`` along the optical axis of distances along all rays."""
        return distance_m * (self.rays() @ self.pose.world_from_camera[:, 2].astype(np.float32))


PictureRays: TypeAlias = PanoramaRays | PerspectiveRays
"""Pixels of a picture: rays, and depth from distances along the rays."""


def draw_rays(
    rng: np.random.Generator, kind: ViewKind, location: NDArray[np.float64], size: int
) -> PerspectiveRays:
    """Draw a perspective view from a location.

    Args:
        rng: Source of randomness.
        kind: See `RoomSettings.views`.
        location: ``(3,)`` center in meters.
        size: Side in pixels.
    """
    heading = rng.uniform(-math.pi, math.pi)
    if kind == "uniform":
        pitch, roll = math.asin(rng.uniform(-1, 1)), rng.uniform(-math.pi, math.pi)
    else:
        spread = math.radians(35 if kind == "wide" else 20)
        pitch = float(np.clip(rng.normal(0, spread), -1.4, 1.4))
        roll = rng.normal(0, math.radians(3))
    fov = math.radians(rng.uniform(96, 106) if kind == "wide" else rng.uniform(45, 75))
    return PerspectiveRays(Pose.looking(location, heading, pitch, roll), size, fov)
