"""Decoder of the files of Stanford2D3DS, and its class table."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from datamodules.core.images import ImageFiles, PngReader, resize_nearest
from datamodules.stanford2d3ds.files import CLASSES, MISSING_DEPTH, MISSING_LABEL, UNKNOWN_CLASS
from datamodules.synthrooms.camera import CAMERA_FROM_SPHERE, euler_rotation
from tangent_train.errors import DataError, SettingError, counted
from tangent_train.files import read_json
from tangent_train.geometry import PanoramaPose
from tangent_train.io.pixel_files import read_pixels, read_rgb

UNKNOWN = 0
"""Label of pixels without a class, which are ignored in training and evaluation."""

_FORMATS = {"rgb": (8, ("RGB", "RGBA")), "labels": (8, ("RGB", "RGBA")), "depth": (16, ("gray",))}
_CENTERS_FROM_CORNERS = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])


@dataclass(frozen=True, eq=False)
class LabelTable:
    """Class of every instance of the data set.

    A pixel of a `semantic` image holds the index of an instance as the color
    R · 65536 + G · 256 + B. Missing labels are #0D0D0D = 855309, past the end of the table.
    (Without R they would be instance 3341, clutter.)

    Attributes:
        class_ids: ``(entries,)`` uint8, 1 to 13 in the order of `CLASSES`, or `UNKNOWN`.
    """

    class_ids: NDArray[np.uint8]

    @classmethod
    def from_json(cls, path: Path) -> LabelTable:
        """Read `semantic_labels.json`, a list of names ``class_instance_room_number_area``.

        Args:
            path: File to read.

        Raises:
            DataError: The file cannot be read or is not such a list.
        """
        expected = "semantic_labels.json of the release: a list of names"
        names = read_json(path, expected, kind=list[str])
        ids = {UNKNOWN_CLASS: UNKNOWN} | {name: i for i, name in enumerate(CLASSES, start=1)}
        classes = [name.partition("_")[0] for name in names]
        if strange := sorted(set(classes) - set(ids)):
            raise DataError(path, found=f"class {strange[0]!r}", expected=expected)
        return cls(np.array([ids[name] for name in classes], np.uint8))

    def decode(self, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the labels of a `semantic` image; instances past the end of the table are unknown.

        Args:
            colors: ``(H, W, 3)`` uint8 in RGB order.

        Returns:
            ``(H, W)`` uint8 labels.

        >>> table = LabelTable(np.array([0, 1, 12], np.uint8))
        >>> table.decode(np.array([[[0, 0, 2], [13, 13, 13], [0, 0, 3]]], np.uint8)).tolist()
        [[12, 0, 0]]
        """
        instances = _instances(colors)
        past = instances >= len(self.class_ids)
        instances[past] = 0
        return np.where(past, np.uint8(UNKNOWN), self.class_ids[instances])

    def past_end(self, colors: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return the instances past the end of the table, except the value of missing labels.

        Args:
            colors: See `decode`.

        Returns:
            ``(n,)`` instances of n pixels.
        """
        instances = _instances(colors)
        return instances[(instances >= len(self.class_ids)) & (instances != MISSING_LABEL)]


def _instances(colors: NDArray[np.uint8]) -> NDArray[np.int32]:
    red, green, blue = np.moveaxis(colors.astype(np.int32), -1, 0)
    return (red << 16) | (green << 8) | blue


@dataclass(frozen=True)
class StanfordReader(PngReader):
    """Reader of panoramas and photos.

    Attributes:
        table: Classes of the instances.
    """

    table: LabelTable

    formats = _FORMATS

    @property
    def settings(self) -> dict[str, str]:
        """See `ImageReader`: a digest of the class table."""
        return {"class table": hashlib.sha256(self.table.class_ids.tobytes()).hexdigest()}

    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Return the labels by the class table."""
        colors = read_rgb(files.parts["labels"])
        return self.table.decode(colors if shape is None else resize_nearest(colors, shape))

    def label_warning(self, files: ImageFiles) -> str:
        """See `ImageReader`: instances past the end of the class table."""
        past = self.table.past_end(read_rgb(files.parts["labels"]))
        if not past.size:
            return ""
        return (
            f"{files.labels}: {counted(past.size, 'pixels')} of instance {past.min()} or higher, "
            f"past the end of the class table ({len(self.table.class_ids) - 1}), are unknown: use "
            "the file and semantic_labels.json of one release."
        )

    def depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Read depth in steps of 1/512 m, as in the files."""
        return read_depth(files.parts["depth"])

    def pose(self, files: ImageFiles) -> PanoramaPose | None:
        """Read the pose in the pose file; None without a file."""
        pose = files.rgb.name.removesuffix("rgb.png") + "pose.json"
        path = files.rgb.parents[1] / "pose" / pose
        if not path.is_file():
            return None
        return read_panorama_pose(path) if files.camera is None else read_photo_pose(path)

    def camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """Read the camera matrix in the pose file."""
        return read_camera_matrix(files.parts["camera"])


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
    """Read the pose of a photo, in the axes of `LabeledImage`.

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
