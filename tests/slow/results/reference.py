"""Reference for the pictures of the viewer: directions and colours in float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rays(
    shape: tuple[int, int], lon_deg: float, lat_deg: float, width_deg: float, projection: str
) -> NDArray[np.float64]:
    """Directions of the pixels of a view: x ahead at longitude 0, y at longitude 90°, z up.

    Args:
        shape: Height and width of the canvas.
        lon_deg: Longitude of its middle.
        lat_deg: Latitude of its middle.
        width_deg: Angle along its longer side.
        projection: ``inside`` (gnomonic) or ``planet`` (stereographic).
    """
    height, width = shape
    half = max(shape) / 2
    x = (np.arange(width) + 0.5 - width / 2) / half
    y = (height / 2 - np.arange(height) - 0.5) / half
    right, up = np.meshgrid(x, y)
    radius, turn = np.hypot(right, up), np.arctan2(up, right)
    edge = np.radians(width_deg) / 2
    angle = (
        np.arctan(radius * np.tan(edge))
        if projection == "inside"
        else 2 * np.arctan(radius * np.tan(edge / 2))
    )
    local = np.stack(
        [np.cos(angle), np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn)], axis=-1
    )
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    tilt = np.array([[np.cos(lat), 0, -np.sin(lat)], [0, 1, 0], [np.sin(lat), 0, np.cos(lat)]])
    spin = np.array([[np.cos(lon), -np.sin(lon), 0], [np.sin(lon), np.cos(lon), 0], [0, 0, 1]])
    directions: NDArray[np.float64] = local @ (spin @ tilt).T
    return directions


def erp_directions(height: int, width: int) -> NDArray[np.float64]:
    """Directions of the pixel centres of a panorama."""
    lon = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    lat = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    lon, lat = np.meshgrid(lon, lat)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def colors_of(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """A colour for every direction, smooth over the whole sphere, no two directions alike."""
    return 127.5 + 100 * directions


def classes_of(directions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Classes 1 to 8: octants of the sphere; 0 within 20° of longitude 0, latitude 0."""
    signs = directions > 0
    octants = 1 + signs[..., 0] + 2 * signs[..., 1] + 4 * signs[..., 2]
    ahead = directions[..., 0] > np.cos(np.radians(20))
    classes: NDArray[np.uint8] = np.where(ahead, 0, octants).astype(np.uint8)
    return classes


def interpolated(
    panorama: NDArray[np.uint8], directions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Bilinear colours: columns wrap, and beyond a pole lies the row of the other side.

    Args:
        panorama: ``(H, W, 3)``, W even.
        directions: ``(..., 3)`` unit vectors.
    """
    height, width = panorama.shape[:2]
    lon = np.arctan2(directions[..., 1], directions[..., 0])
    lat = np.arcsin(directions[..., 2].clip(-1, 1))
    column = (lon + np.pi) / (2 * np.pi) * width - 0.5
    row = (np.pi / 2 - lat) / np.pi * height - 0.5
    color = np.zeros(directions.shape)
    for down in (0, 1):
        for right in (0, 1):
            r, c = np.floor(row).astype(int) + down, np.floor(column).astype(int) + right
            weight = (1 - abs(row - r)) * (1 - abs(column - c))
            beyond = (r < 0) | (r >= height)
            c = (c + beyond * (width // 2)) % width
            color += weight[..., None] * panorama[r.clip(0, height - 1), c]
    return color
