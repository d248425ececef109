"""Poses of Stanford2D3DS's panoramas.

`SynthRooms` writes poses as `datamodules.synthrooms.camera` states, and they are read to rounding.

Of the real set this is known. Its panoramas are upright. In `camera_rt_matrix` R takes world to
camera coordinates, x right, y down, z forward; in photos R is ``diag(1, −1, −1) Fᵀ`` with the Euler
rotation F of `final_camera_rotation` (2D-3D-Semantics issues 26 and 50). Of panoramas, its issues
16 and 42 say that a point is ``A R A x' + c``: x' in the panorama's own coordinates, taken here for
x right, y down, z to the middle; c the `camera_location`; A the Euler rotation of
`camera_original_rotation`. Where F = A, as in our files, that is ``Rᵀ x' + c``. It is computed so
for both. No file of the real set was at hand to try it on: the overlap of the fields of view
computed from depth and pose, which ``tangent-keypoints`` puts beside the paper's, tells whether it
is right.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from datamodules.synthrooms.camera import CAMERA_FROM_SPHERE, euler_rotation
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import PanoramaPose
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["read_panorama_pose"]

_KEYS = {"camera_rt_matrix": (3, 4), "camera_original_rotation": (3,), "camera_location": (3,)}
_REMEDY = "Copy or extract the file again."


def read_panorama_pose(path: Path) -> PanoramaPose:
    """Read the pose file of a panorama.

    Args:
        path: ``…_domain_pose.json``.

    Raises:
        DataError: It cannot be read, or holds no pose.
    """
    record = _read_record(path)
    rt, angles, location = (_numbers(path, record, key, shape) for key, shape in _KEYS.items())
    if np.abs(angles).max() > 2 * math.pi:
        angles = np.radians(angles)
    original = euler_rotation(angles)
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # huge numbers make no rotation
            turn = original @ rt[:, :3] @ original @ CAMERA_FROM_SPHERE
            return PanoramaPose(turn, location)
    except SettingError as error:
        raise DataError(
            path, found=f"a camera_rt_matrix that is no rotation ({error})", expected="one"
        ) from error


def _read_record(path: Path) -> dict[str, Any]:
    try:
        record = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(path, found=error, expected="a pose as JSON", remedy=_REMEDY) from error
    if not isinstance(record, dict):
        raise DataError(path, found="other JSON", expected="a pose", remedy=_REMEDY)
    return record


def _numbers(
    path: Path, record: dict[str, Any], key: str, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    try:
        values = np.array(record.get(key), np.float64)
    except (ValueError, TypeError, OverflowError):
        values = np.array(np.nan)
    # Some releases have a fourth row 0 0 0 1.
    values = values[:3] if values.shape == (4, 4) else values
    if values.shape != shape or not np.isfinite(values).all():
        raise DataError(
            path,
            found=f"{key} {record.get(key, 'missing')}",
            expected=f"{'×'.join(map(str, shape))} numbers",
            remedy=_REMEDY,
        )
    return values
