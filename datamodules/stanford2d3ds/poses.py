"""Poses of Stanford2D3DS's panoramas.

`SynthRooms` writes poses as `datamodules.synthrooms.camera` states, and they are read to rounding.

Of the real set this is known. Its panoramas are upright. In `camera_rt_matrix` R takes world to
camera coordinates, x right, y down, z forward; in photos R is ``diag(1, −1, −1) Fᵀ`` with the Euler
rotation F of `final_camera_rotation` (2D-3D-Semantics issues 26 and 50). Of panoramas, its issues
16 and 42 say that a point is ``A R A x' + c``: x' in the panorama's own coordinates, taken here for
x right, y down, z to the middle; c the `camera_location`; A the Euler rotation of
`camera_original_rotation`. Where F = A, as in our files, that is ``Rᵀ x' + c``. Both are read
this way. Not yet verified on the real set: compare the overlap of the fields of view from depth and
pose, which ``tangent-keypoints`` shows beside the paper's.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.synthrooms.camera import CAMERA_FROM_SPHERE, euler_rotation
from tangent_train.errors import DataError
from tangent_train.files import parse_json
from tangent_train.geometry import PanoramaPose

__all__ = ["read_panorama_pose"]

_MOST = 1e6  # metres and radians
_KEYS = {"camera_rt_matrix": (3, 4), "camera_original_rotation": (3,), "camera_location": (3,)}


def read_panorama_pose(path: Path) -> PanoramaPose:
    """Read the pose file of a panorama.

    Args:
        path: ``…_domain_pose.json``.

    Raises:
        DataError: It cannot be read, or holds no pose.
    """
    try:
        record = parse_json(path.read_bytes())
        rt, angles, location = (_numbers(record[key], shape) for key, shape in _KEYS.items())
        if np.abs(angles).max() > 2 * math.pi:
            angles = np.radians(angles)
        original = euler_rotation(angles)
        return PanoramaPose(original @ rt[:, :3] @ original @ CAMERA_FROM_SPHERE, location)
    except (OSError, ValueError, TypeError, KeyError, OverflowError, FloatingPointError) as error:
        raise DataError(
            path,
            found=f"{type(error).__name__}: {error}",
            expected=f"a pose as JSON, with {', '.join(_KEYS)}",
            remedy="Copy or extract the file again.",
        ) from error


def _numbers(value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    numbers = np.array(value, np.float64)
    # Some releases have a fourth row 0 0 0 1.
    numbers = numbers[:3] if numbers.shape == (4, 4) else numbers
    if numbers.shape != shape or not np.abs(numbers).max() <= _MOST:
        raise ValueError(f"{value}, not {'×'.join(map(str, shape))} numbers")
    return numbers
