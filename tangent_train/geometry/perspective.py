"""Single pinhole images, each in a direction of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError, at_least
from tangent_train.geometry.camera import half_width
from tangent_train.geometry.grids import PinholeGrid
from tangent_train.geometry.sphere import rotation_about

Angles = float | Sequence[float] | NDArray[Any]
"""An angle in degrees, or one for each image."""

_FRONT: NDArray[np.float64] = np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]])
"""Camera axes of the image to the middle of the panorama, as `PinholeGrid.world_from_camera`."""


def view_rotation(yaw_deg: float, pitch_deg: float, roll_deg: float) -> NDArray[np.float64]:
    """Return the rotation ``(3, 3)`` of a view: clockwise, then up, then to the right."""
    yaw, pitch, roll = np.radians((yaw_deg, pitch_deg, roll_deg))
    # A positive rotation about y looks down.
    tilt = rotation_about((0, 1, 0), -pitch) @ rotation_about((1, 0, 0), -roll)
    return rotation_about((0, 0, 1), yaw) @ tilt


def perspective_grid(
    yaw_deg: Angles,
    pitch_deg: Angles,
    fov_deg: float | Sequence[float],
    size: int | Sequence[int],
    roll_deg: Angles = 0.0,
) -> PinholeGrid:
    """Return pinhole images of one camera in given directions, which need not cover the sphere.

    Args:
        yaw_deg: Angles to the right of the middle of the panorama.
        pitch_deg: Angles above the horizon.
        fov_deg: Horizontal field of view between the outer pixel edges; or the least horizontal and
            vertical one, because pixels are square.
        size: Columns and rows of the images, such as (640, 480); or one number for both.
        roll_deg: Angles by which the cameras are rolled clockwise.

    Raises:
        SettingError: An angle or the size cannot be used.

    >>> perspective_grid([0, 90], 0, 90, (640, 480)).size
    (480, 640)
    """
    columns, rows = (at_least("size", side, 2) for side in _pair("size", size))
    across, down = map(half_width, _pair("fov", fov_deg))
    least = 2 * down / rows if np.ndim(fov_deg) else 0.0
    pitch = max(2 * across / columns, least)
    try:
        angles = np.broadcast_arrays(*map(_degrees, (yaw_deg, pitch_deg, roll_deg)))
    except (TypeError, ValueError) as error:
        found = ", ".join(str(angle) for angle in (yaw_deg, pitch_deg, roll_deg))
        expected = "finite degrees: numbers, or lists of one length"
        raise SettingError("yaw, pitch and roll", found=found, expected=expected) from error
    axes = np.stack([view_rotation(*each) @ _FRONT for each in np.stack(angles, -1)])
    return PinholeGrid(axes, (rows, columns), pitch, is_overlapping=False)


def _degrees(angles: Angles) -> NDArray[np.float64]:
    degrees = np.atleast_1d(np.asarray(angles, np.float64))
    if degrees.ndim > 1 or not degrees.size or not np.isfinite(degrees).all():
        raise ValueError("not a list of finite numbers")
    return degrees


def _pair(name: str, value: Any) -> tuple[Any, Any]:
    pair = (value, value) if np.ndim(value) == 0 else tuple(value)
    if len(pair) != 2:
        raise SettingError(name, found=value, expected="a number, or [horizontal, vertical]")
    return pair[0], pair[1]
