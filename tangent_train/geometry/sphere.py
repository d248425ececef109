"""Directions, equirectangular pixels, rotations and poses.

The convention is stated in `tangent_train.geometry`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError, at_least

Floats = NDArray[np.float64]
"""Directions, rotations and other float64 arrays."""

MOST_ROWS = 2**15
"""Rows of a panorama, and sides of an image, at most: 2 gigapixels."""


def lonlat_to_xyz(lonlat_rad: ArrayLike) -> Floats:
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


def xyz_to_lonlat(directions_xyz: ArrayLike) -> Floats:
    """Return longitude in [−π, π] and latitude of directions; inverse of `lonlat_to_xyz`.

    Args:
        directions_xyz: ``(..., 3)`` non-zero vectors of any length.

    Returns:
        ``(..., 2)`` radians.
    """
    x, y, z = np.moveaxis(np.asarray(directions_xyz, np.float64), -1, 0)
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1)


def to_right_handed(vectors_xyz: ArrayLike) -> Floats:
    """Convert vectors from the frame of the sphere (y right) to that of files (y left), or back.

    Point clouds, poses and cameras are stored in the frame of files. A matrix that maps vectors of
    one frame is converted to the matrix that maps those of the other.

    Args:
        vectors_xyz: ``(..., 3)`` vectors.
    """
    return np.asarray(np.asarray(vectors_xyz, np.float64) @ np.diag([1.0, -1.0, 1.0]))


def rotation_about(axis_xyz: ArrayLike, angle_rad: float) -> Floats:
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


def random_rotation(rng: np.random.Generator) -> Floats:
    """Draw a rotation uniformly from SO(3) (a uniform unit quaternion).

    Args:
        rng: Source of randomness.

    Returns:
        ``(3, 3)`` rotation matrix.
    """
    w, *axis = rng.normal(size=4)
    return rotation_about(axis, 2 * np.arctan2(np.linalg.norm(axis), w))


def checked_rotation(rotation: ArrayLike) -> Floats:
    """Return a copy of a rotation matrix.

    Args:
        rotation: ``(3, 3)`` matrix.

    Raises:
        SettingError: The matrix is not a proper rotation.
    """
    try:
        matrix = np.array(rotation, np.float64)
    except (TypeError, ValueError):
        matrix = np.array(repr(rotation))
    if (
        matrix.shape != (3, 3)
        or not np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6)
        or np.linalg.det(matrix) < 0
    ):
        raise SettingError(
            "rotation", found=matrix.tolist(), expected="a 3×3 rotation matrix of determinant +1"
        )
    return matrix


def equirect_shape(level: int) -> tuple[int, int]:
    """Return rows and columns of the panorama that matches a level-s icosahedron.

    Args:
        level: Level s, 0 to 14.

    Returns:
        ``(2 ** (s + 1), 2 ** (s + 2))`` (paper, figure "icosahedral levels").

    Raises:
        SettingError: The level is out of range.

    >>> equirect_shape(10)
    (2048, 4096)
    """
    at_least("level", level, 0, 14)
    return 2 ** (level + 1), 2 ** (level + 2)


def panorama_rows(level: int, rows: int | None) -> int:
    """Return the number of rows of a panorama; by default that of level s, see `equirect_shape`.

    Raises:
        SettingError: The level or the number is out of range.
    """
    if rows is None:
        return equirect_shape(level)[0]
    return at_least("representation.erp_height", rows, 1, MOST_ROWS)


def nearest_level(height: int) -> int:
    """Return the level s whose panoramas, of 2^(s+1) rows, are nearest in size.

    Sizes are compared by their ratio: 724 rows are nearer to 512 than to 1024, 725 to 1024.

    Args:
        height: Rows of the panorama, 2 or more.

    >>> [nearest_level(rows) for rows in (512, 724, 725, 1024, 2688)]
    [8, 8, 9, 9, 10]
    """
    return round(math.log2(height)) - 1


def equirect_to_lonlat(pixels_xy: ArrayLike, shape: tuple[int, int]) -> Floats:
    """Return longitude and latitude of ERP pixel positions.

    Args:
        pixels_xy: ``(..., 2)`` column u and row v; pixel centers are integers.
        shape: ``(H, W)`` of the panorama.

    Returns:
        ``(..., 2)`` radians.
    """
    u, v = np.moveaxis(np.asarray(pixels_xy, np.float64), -1, 0)
    lon = (u + 0.5) / shape[1] * 2 * np.pi - np.pi
    return np.stack([lon, np.pi / 2 - (v + 0.5) / shape[0] * np.pi], axis=-1)


def lonlat_to_equirect(lonlat_rad: ArrayLike, shape: tuple[int, int]) -> Floats:
    """Return ERP pixel positions of longitudes and latitudes; inverse of `equirect_to_lonlat`.

    Args:
        lonlat_rad: ``(..., 2)`` radians, longitude in [−π, π].
        shape: ``(H, W)`` of the panorama.

    Returns:
        ``(..., 2)`` column u in [−½, W − ½] and row v in [−½, H − ½].
    """
    lon, lat = np.moveaxis(np.asarray(lonlat_rad, np.float64), -1, 0)
    u = (lon + np.pi) / (2 * np.pi) * shape[1] - 0.5
    return np.stack([u, (np.pi / 2 - lat) / np.pi * shape[0] - 0.5], axis=-1)


def equirect_latitudes(height: int, shift: float = 0.0) -> Floats:
    """Return the latitude of every row, from north to south.

    Args:
        height: Rows H.
        shift: Pixels down from the center of a row.

    Returns:
        ``(H,)`` radians.
    """
    return np.pi / 2 - (np.arange(height) + shift + 0.5) / height * np.pi


def equirect_longitudes(width: int, shift: float = 0.0) -> Floats:
    """Return the longitude of every column, from west to east.

    Args:
        width: Columns W.
        shift: Pixels to the right from the center of a column.

    Returns:
        ``(W,)`` radians.
    """
    return (np.arange(width) + shift + 0.5) / width * 2 * np.pi - np.pi


def equirect_directions(shape: tuple[int, int]) -> Floats:
    """Return the direction of every ERP pixel center.

    Args:
        shape: ``(H, W)``.

    Returns:
        ``(H, W, 3)`` unit vectors.
    """
    angles = np.meshgrid(equirect_longitudes(shape[1]), equirect_latitudes(shape[0]))
    return lonlat_to_xyz(np.stack(angles, axis=-1))


def equirect_elevations(
    shape: tuple[int, int], up_xyz: ArrayLike = (0.0, 0.0, 1.0)
) -> NDArray[np.float32]:
    """Return the sine of the elevation angle of every ERP pixel.

    Args:
        shape: ``(H, W)``.
        up_xyz: ``(3,)`` direction of the zenith, a unit vector.

    Returns:
        ``(H, W)`` from −1, straight down, to 1.

    >>> np.degrees(np.arcsin(equirect_elevations((2, 4))[:, 0])).round().tolist()
    [45.0, -45.0]
    """
    up = np.asarray(up_xyz, np.float64)
    latitudes, lon = equirect_latitudes(shape[0]), equirect_longitudes(shape[1])
    across = (np.cos(lon) * up[0] + np.sin(lon) * up[1]).astype(np.float32)
    elevations = np.outer(np.cos(latitudes).astype(np.float32), across)
    elevations += (np.sin(latitudes) * up[2]).astype(np.float32)[:, None]
    return elevations


def equirect_solid_angles(shape: tuple[int, int]) -> Floats:
    """Return the exact solid angle of a pixel of every row: ``2π/W · (sin φ_top − sin φ_bottom)``.

    Args:
        shape: ``(H, W)``.

    Returns:
        ``(H,)`` steradians; times W they add up to 4π.
    """
    height, width = shape
    edges = np.sin(np.pi / 2 - np.arange(height + 1) / height * np.pi)
    return 2 * np.pi / width * (edges[:-1] - edges[1:])


def check_area(angles: Sequence[float] | None, setting: str = "area") -> tuple[float, ...]:
    """Return west, east, south and north of a part of the sphere.

    Args:
        angles: Edges in degrees: longitudes −180 to 180, with ``west > east`` for an area across
            ±180° and -180, 180 for all around; latitudes −90 to 90. None for the whole sphere.
        setting: Name of the setting, for messages.

    Raises:
        SettingError: The angles are not those of an area.
    """
    if angles is None:
        return -180, 180, -90, 90
    given = [*angles] if isinstance(angles, Iterable) else [angles]
    is_area = len(given) == 4 and all(isinstance(angle, Real) for angle in given)
    west, east, south, north = given if is_area else (0, 0, 0, 0)
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south < north <= 90) or (
        (east - west) % 360 == 0 and (west, east) != (-180, 180)
    ):
        raise SettingError(
            setting,
            found=given,
            expected="[west,east,south,north] in degrees, −180 to 180 and −90 to 90, south below "
            "north, east other than west; [-180,180,…] is all around",
        )
    return west, east, south, north


def area_mask(angles: Sequence[float], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return a mask ``(H, W)`` of the pixels whose center lies in an area, see `check_area`."""
    west, east, south, north = angles
    latitudes = np.degrees(equirect_latitudes(shape[0]))
    longitudes = np.degrees(equirect_longitudes(shape[1]))
    width = east - west if east > west else east - west + 360
    return np.outer((south <= latitudes) & (latitudes <= north), (longitudes - west) % 360 <= width)


def tangent_axes(directions_xyz: ArrayLike) -> Floats:
    """Return east, north and the unit vector itself of each direction.

    Both poles have longitude 0: y points to the east of either.

    Args:
        directions_xyz: ``(..., 3)`` non-zero vectors of any length.

    Returns:
        ``(..., 3, 3)`` unit vectors as rows.
    """
    xyz = np.asarray(directions_xyz, np.float64)
    xyz = xyz / np.linalg.norm(xyz, axis=-1, keepdims=True)
    x, y = xyz[..., 0], xyz[..., 1]
    lon = np.where(np.hypot(x, y) < 1e-9, 0.0, np.arctan2(y, x))
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    return np.stack([east, np.cross(xyz, east), xyz], axis=-2)


def gnomonic_points_xyz(
    directions_xyz: ArrayLike, kernel: int | tuple[int, int], pitch: float
) -> Floats:
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
        # A reflection times −1 is a rotation.
        checked_rotation(self.world_from_panorama * np.linalg.det(self.world_from_panorama))

    def points_m(self, directions_xyz: ArrayLike, distance_m: ArrayLike) -> Floats:
        """Return world points ``(…, 3)`` in directions ``(…, 3)`` at distances ``(…)``."""
        ahead = np.asarray(directions_xyz, np.float64) @ self.world_from_panorama.T
        return self.location_m + ahead * np.asarray(distance_m, np.float64)[..., None]

    def project(self, points_m: ArrayLike) -> tuple[Floats, Floats]:
        """Return directions ``(…, 3)`` and distances ``(…)`` in meters of world points ``(…, 3)``.

        A point at the center itself has the direction 0.
        """
        offset = (np.asarray(points_m, np.float64) - self.location_m) @ self.world_from_panorama
        distance = np.linalg.norm(offset, axis=-1)
        return offset / np.where(distance > 0, distance, 1.0)[..., None], distance

    def relative_to(self, other: PanoramaPose) -> tuple[Floats, Floats]:
        """Return rotation and shift from another panorama to this one: ``x_this = R x_other + t``.

        Args:
            other: Pose in the same world.

        Returns:
            R ``(3, 3)``, a rotation, and t ``(3,)`` in meters: the position of the other's center.
        """
        rotation = self.world_from_panorama.T @ other.world_from_panorama
        return rotation, (other.location_m - self.location_m) @ self.world_from_panorama
