"""Equirectangular pixels; the convention is stated in `tangent_train.geometry`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.sphere import lonlat_to_xyz


def equirect_shape(level: int) -> tuple[int, int]:
    """Return rows and columns of the panorama that matches a level-s icosahedron.

    Args:
        level: Level s, 0 or more.

    Returns:
        ``(2 ** (s + 1), 2 ** (s + 2))`` (paper, figure "icosahedral levels").

    Raises:
        SettingError: The level is negative.

    >>> equirect_shape(10)
    (2048, 4096)
    """
    if level < 0:
        raise SettingError("level", found=level, expected="0 or more")
    return 2 ** (level + 1), 2 ** (level + 2)


def nearest_level(height: int) -> int:
    """Return the level s whose panoramas, of 2^(s+1) rows, are nearest in size.

    Sizes are compared by their ratio: 724 rows are nearer to 512 than to 1024, 725 to 1024.

    Args:
        height: Rows of the panorama, 2 or more.

    Raises:
        SettingError: There are fewer than 2 rows.

    >>> [nearest_level(rows) for rows in (512, 724, 725, 1024, 2688)]
    [8, 8, 9, 9, 10]
    """
    if height < 2:
        raise SettingError("panorama", found=f"{height} rows", expected="2 or more")
    return round(math.log2(height)) - 1


def equirect_to_lonlat(pixels_xy: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return longitude and latitude of ERP pixel positions.

    Args:
        pixels_xy: ``(..., 2)`` column u and row v; pixel centers are integers.
        shape: ``(H, W)`` of the panorama.

    Returns:
        ``(..., 2)`` radians.
    """
    u, v = np.moveaxis(np.asarray(pixels_xy, np.float64), -1, 0)
    height, width = shape
    lon = (u + 0.5) / width * 2 * np.pi - np.pi
    return np.stack([lon, np.pi / 2 - (v + 0.5) / height * np.pi], axis=-1)


def lonlat_to_equirect(lonlat_rad: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return ERP pixel positions of longitudes and latitudes; inverse of `equirect_to_lonlat`.

    Args:
        lonlat_rad: ``(..., 2)`` radians, longitude in [−π, π].
        shape: ``(H, W)`` of the panorama.

    Returns:
        ``(..., 2)`` column u in [−½, W − ½] and row v in [−½, H − ½].
    """
    lon, lat = np.moveaxis(np.asarray(lonlat_rad, np.float64), -1, 0)
    height, width = shape
    u = (lon + np.pi) / (2 * np.pi) * width - 0.5
    return np.stack([u, (np.pi / 2 - lat) / np.pi * height - 0.5], axis=-1)


def equirect_latitudes(height: int, shift: float = 0.0) -> NDArray[np.float64]:
    """Return the latitude of every row, from north to south.

    Args:
        height: Rows H.
        shift: Pixels down from the center of a row.

    Returns:
        ``(H,)`` radians.
    """
    return np.pi / 2 - (np.arange(height) + shift + 0.5) / height * np.pi


def equirect_longitudes(width: int, shift: float = 0.0) -> NDArray[np.float64]:
    """Return the longitude of every column, from west to east.

    Args:
        width: Columns W.
        shift: Pixels to the right from the center of a column.

    Returns:
        ``(W,)`` radians.
    """
    return (np.arange(width) + shift + 0.5) / width * 2 * np.pi - np.pi


def equirect_directions(shape: tuple[int, int]) -> NDArray[np.float64]:
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


def equirect_solid_angles(shape: tuple[int, int]) -> NDArray[np.float64]:
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
    west, east, south, north = angles if len(angles) == 4 else (0, 0, 0, 0)
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south < north <= 90) or (
        (east - west) % 360 == 0 and (west, east) != (-180, 180)
    ):
        raise SettingError(
            setting,
            found=list(angles),
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
