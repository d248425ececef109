"""Views for a figure of tangent images: cells with borders, the images' planes from inside."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import TangentGrid, lonlat_to_equirect, xyz_to_lonlat
from tangent_train.rendering.sampling import EquirectMap

__all__ = ["FINER", "from_inside", "inside_positions", "with_borders"]

_Image = NDArray[np.uint8]

FINER = 3
"""Borders are found at so many times the resolution they are drawn at."""

_EYE = np.array([-0.78, 0.0, 0.0])
"""Where the eye is: behind the centre, inside the sphere that the planes touch."""
_FOV_DEG = 100.0
_SHADE = 0.6
"""How much darker planes are that are seen from the side."""
_LINES = 0.85
"""How much of what is behind them lines cover."""
_BLOCK = 2**18


def with_borders(
    image: _Image, owners: NDArray[np.integer | np.bool_], width: float = 1.0
) -> _Image:
    """Draw white lines where the owner changes.

    Args:
        image: ``(h, w, 3)``.
        owners: ``(FINER·h, FINER·w)`` which image each place belongs to.
        width: Of the lines in pixels.
    """
    change = np.zeros(owners.shape, np.uint8)
    change[:, 1:] |= owners[:, 1:] != owners[:, :-1]
    change[1:] |= owners[1:] != owners[:-1]
    wide = cv2.dilate(change, np.ones((round(width * FINER),) * 2, np.uint8))
    size = (image.shape[1], image.shape[0])
    share = _LINES * cv2.resize(wide.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.rint(image + share[..., None] * (255.0 - image)).astype(np.uint8)


def from_inside(panorama: _Image, grid: TangentGrid, size: tuple[int, int]) -> _Image:
    """The polyhedron of the image planes, seen from inside it.

    Every image is a window onto its plane at distance 1 from the centre. The eye stands back from
    the centre and looks ahead, so that planes are seen as planes.

    Args:
        panorama: ``(H, W, 3)``.
        grid: The images.
        size: Width and height.

    Returns:
        ``(height, width, 3)``.
    """
    width, height = (FINER * side for side in size)
    rays = _rays(width, height)
    owners, distances = np.empty(len(rays), np.int32), np.empty(len(rays))
    normals = grid.centers_xyz
    # The plane n · p = 1 is at 1 / (n · ray) of what is left of 1 at the eye; the nearest is seen.
    nearness_of = (normals / (1 - normals @ _EYE)[:, None]).T.astype(np.float32)
    for start in range(0, len(rays), _BLOCK):
        part = slice(start, start + _BLOCK)
        nearness = rays[part].astype(np.float32) @ nearness_of
        owners[part] = best = nearness.argmax(axis=1)
        distances[part] = 1 / nearness[np.arange(len(best)), best]
    shape = panorama.shape[:2]
    lonlat_rad = xyz_to_lonlat(_EYE + rays * distances[:, None]).reshape(height, width, 2)
    u, v = np.moveaxis(lonlat_to_equirect(lonlat_rad, shape).astype(np.float32), -1, 0)
    colors = np.empty((height, width, 3), np.uint8)
    EquirectMap(u, v, shape).sample(panorama, "bilinear", colors)
    shade = 1 - _SHADE * (1 - np.abs((rays * normals[owners]).sum(axis=1)))
    shaded = colors * shade.reshape(height, width, 1).astype(np.float32)
    small = cv2.resize(shaded, size, interpolation=cv2.INTER_AREA)
    seen = np.rint(small).astype(np.uint8)
    return with_borders(seen, owners.reshape(height, width), width=2)


def inside_positions(points_xyz: NDArray[np.float64], size: tuple[int, int]) -> NDArray[np.float64]:
    """Where `from_inside` shows points.

    Args:
        points_xyz: ``(N, 3)``.
        size: Width and height of the view.

    Returns:
        ``(N, 2)`` column and row, from the corner of the view; NaN behind the eye.
    """
    ahead, right, up = (points_xyz - _EYE).T
    focal = size[0] / 2 / math.tan(math.radians(_FOV_DEG) / 2)
    scale = focal / np.where(ahead > 0, ahead, np.nan)
    return np.stack([size[0] / 2 + right * scale, size[1] / 2 - up * scale], axis=-1)


def _rays(width: int, height: int) -> NDArray[np.float64]:
    """``(height · width, 3)`` unit directions of the pixels of a view ahead."""
    focal = width / 2 / math.tan(math.radians(_FOV_DEG) / 2)
    right, down = np.meshgrid(
        (np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal
    )
    rays = np.stack([np.ones_like(right), right, -down], axis=-1).reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
