"""Normals of the surfaces that an image sees, from its depth.

A plane with the normal n is seen in a direction r at the distance d with ``f = 1 / d = n · r / c``:
f is linear in the direction. The normal is therefore f and its derivatives, up to a factor, and
slopes of f from neighboring pixels are exact on planes. At edges of objects, the side on which f
bends less counts (as in ENO and WENO schemes, Jiang & Shu 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry.sphere import Floats, equirect_latitudes, equirect_longitudes

_OFFSETS = (-2, -1, 1, 2)


def equirect_normals(distance: NDArray[np.floating]) -> Floats:
    """Return the normals of the surfaces around a panorama.

    Slopes along a row are taken over as many pixels as make a step of the height of a pixel.

    Args:
        distance: ``(H, W)`` distances from the center, 0 or NaN where unknown.

    Returns:
        ``(H, W, 3)`` unit vectors that face the center, in the frame of `tangent_train.geometry`;
        NaN where the distance is unknown, or known in fewer than three pixels in a line.
    """
    height, width = distance.shape
    inverse, latitude = _inverse(distance), equirect_latitudes(height)[:, None]
    sin, cos, pitch = np.sin(latitude), np.cos(latitude), np.pi / height
    beyond = np.roll(inverse, width // 2, axis=1)  # a pole
    rows = np.concatenate([beyond[1::-1], inverse, beyond[:-3:-1]])
    around: list[Floats] = [rows[2 - k : height + 2 - k] for k in _OFFSETS]
    north = _slope(inverse, around, inverse * np.cos(pitch), np.sin(pitch))
    up = inverse * sin + north * cos
    of_row = up * sin  # the part of f that a rotation about the vertical leaves
    stride = np.rint(1 / cos).clip(1, max(1, width // 8)).astype(np.int64)
    columns, turn = np.arange(width), 2 * np.pi / width * stride
    around = [np.take_along_axis(inverse, (columns + k * stride) % width, 1) for k in _OFFSETS]
    rest = of_row + (inverse - of_row) * np.cos(turn)
    east = _slope(inverse, around, rest, np.sin(turn) * cos)
    out, longitude = inverse * cos - north * sin, equirect_longitudes(width)
    x = out * np.cos(longitude) - east * np.sin(longitude)
    return _facing(x, out * np.sin(longitude) + east * np.cos(longitude), up)


def pinhole_normals(z_depth: NDArray[np.floating], camera_matrix: Floats) -> Floats:
    """Return the normals of the surfaces in a pinhole image.

    Args:
        z_depth: ``(h, w)`` z-depth, 0 or NaN where unknown.
        camera_matrix: ``(3, 3)`` K for integer pixel centers, without skew.

    Returns:
        ``(h, w, 3)`` unit vectors that face the camera, in camera axes; NaN as in
        `equirect_normals`.
    """
    inverse, (height, width) = _inverse(z_depth), z_depth.shape
    padded = np.pad(inverse, 2, constant_values=np.nan)
    (fx, _, cx), (_, fy, cy), _ = camera_matrix
    columns = [padded[2:-2, 2 + k : width + 2 + k] for k in _OFFSETS]
    rows = [padded[2 + k : height + 2 + k, 2:-2] for k in _OFFSETS]
    right, down = _slope(inverse, columns, inverse, 1 / fx), _slope(inverse, rows, inverse, 1 / fy)
    x, y = (np.arange(width) - cx) / fx, (np.arange(height)[:, None] - cy) / fy
    return _facing(right, down, inverse - x * right - y * down)


def _inverse(depth: NDArray[np.floating]) -> Floats:
    return 1 / np.where(depth > 0, np.asarray(depth, np.float64), np.nan)


def _slope(middle: Floats, around: Sequence[Floats], rest: Floats, step: Any) -> Floats:
    """Return the derivative of values.

    Args:
        middle: ``(H, W)`` values f.
        around: Values 2 and 1 steps before, and 1 and 2 steps after each.
        rest: The value one step away if the derivative is 0.
        step: Length of a step.
    """
    total, weights = np.zeros((2, *middle.shape))
    for sign, far, near in ((-1, 0, 1), (1, 3, 2)):
        # On a plane, f bends by about step² f.
        bend = (middle - 2 * around[near] + around[far]) ** 2 + (step**2 * middle) ** 2
        weight = np.nan_to_num(1 / bend)
        total += weight * np.nan_to_num(sign * (around[near] - rest) / step)
        weights += weight
    return total / np.where(weights > 0, weights, np.nan)


def _facing(x: Floats, y: Floats, z: Floats) -> Floats:
    """Return the unit vectors opposite to some vectors."""
    normals = -np.stack([x, y, z], axis=-1)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))
