"""Decoder of the files of Stanford2D3DS, and its class table."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from datamodules.core.label_map import LabelMap
from datamodules.stanford2d3ds.files import CLASSES, MISSING_DEPTH, UNKNOWN_CLASS
from datamodules.synthrooms.camera import CAMERA_FROM_SPHERE, euler_rotation
from tangent_train.errors import DataError, SettingError
from tangent_train.files import read_json
from tangent_train.geometry import PanoramaPose
from tangent_train.io.pixel_files import read_pixels

_CENTERS_FROM_CORNERS = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])


def read_label_table(path: Path) -> LabelMap:
    """Read `semantic_labels.json`, a list of names ``class_instance_room_number_area``.

    A pixel of a `semantic` image holds the index of an instance as the color
    R · 65536 + G · 256 + B. Missing labels are #0D0D0D = 855309, past the end of the list. (Without
    R they would be instance 3341, clutter.) All instances past the end are unknown.

    Args:
        path: File to read.

    Raises:
        DataError: The file cannot be read or is not such a list.
    """
    expected = "semantic_labels.json of the release: a list of names"
    names = read_json(path, expected, kind=list[str])
    classes = [name.partition("_")[0] for name in names]
    if strange := sorted(set(classes) - {UNKNOWN_CLASS, *CLASSES}):
        raise DataError(path, found=f"class {strange[0]!r}", expected=expected)
    instances = {
        name: [f"#{i:06x}" for i, of in enumerate(classes) if of == name] for name in CLASSES
    }
    return LabelMap.of(instances, refuses_others=False)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Read depth in steps of 1/512 m, 0 where missing.

    Raises:
        DataError: The file is broken.
    """
    steps = read_pixels(path, indices=True)
    steps[steps == MISSING_DEPTH] = 0
    return steps


class _PoseRecord(BaseModel):
    """Numbers of a pose file; some releases have a fourth row 0 0 0 1."""

    model_config = ConfigDict(allow_inf_nan=False)

    camera_k_matrix: list[tuple[float, float, float]] = Field(min_length=3, max_length=3)
    camera_rt_matrix: list[tuple[float, float, float, float]] = Field(min_length=3, max_length=4)
    camera_original_rotation: tuple[float, float, float]
    camera_location: tuple[float, float, float]


def _read_pose_file(path: Path) -> _PoseRecord:
    record: _PoseRecord = read_json(path, "a pose file of the release", kind=_PoseRecord)
    return record


def read_camera_matrix(path: Path) -> NDArray[np.float64]:
    """Read the camera matrix of a pose file.

    Args:
        path: ``camera_…_domain_pose.json``.

    Returns:
        ``(3, 3)`` K for integer pixel centers (the file counts from pixel corners).

    Raises:
        DataError: The file is missing or broken.
    """
    matrix: NDArray[np.float64] = np.array(_read_pose_file(path).camera_k_matrix)
    return _CENTERS_FROM_CORNERS @ matrix


def read_panorama_pose(path: Path) -> PanoramaPose:
    """Read the pose file of a panorama.

    Args:
        path: ``…_domain_pose.json``.

    Raises:
        DataError: It cannot be read.
    """
    record = _read_pose_file(path)
    angles = np.array(record.camera_original_rotation)
    if np.abs(angles).max() > 2 * math.pi:
        angles = np.radians(angles)
    original = euler_rotation(angles)
    rotation = np.array(record.camera_rt_matrix)[:3, :3]
    world_from_panorama = original @ rotation @ original @ CAMERA_FROM_SPHERE
    return _checked_pose(path, world_from_panorama, np.array(record.camera_location))


def read_photo_pose(path: Path) -> PanoramaPose:
    """Read the pose of a photo, in the axes of `ImageDataModule.pose`.

    The camera matrix [R | t] of the file takes points of the world to the camera: x right, y down,
    z forward. This was tested with SynthRooms.

    Args:
        path: ``camera_…_domain_pose.json``.

    Raises:
        DataError: It cannot be read.
    """
    rt = np.array(_read_pose_file(path).camera_rt_matrix)
    world_from_camera = rt[:3, :3].T
    location_m = -world_from_camera @ rt[:3, 3]
    return _checked_pose(path, world_from_camera @ CAMERA_FROM_SPHERE, location_m)


def _checked_pose(
    path: Path, world_from_panorama: NDArray[np.float64], location_m: NDArray[np.float64]
) -> PanoramaPose:
    try:
        return PanoramaPose(world_from_panorama, location_m)
    except SettingError as error:
        raise DataError(path, found=error.found, expected="a rotation") from error
