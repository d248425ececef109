"""Cameras of photos: ``cameras.json``, one field of view for all, or EXIF data."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.core.panoramas import ImageFiles
from datamodules.core.problems import Problems
from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.geometry import camera_matrix_from_fov, is_camera_matrix
from tangent_train.io.image_files import composed
from tangent_train.io.pixel_files import photo_fov_deg, read_image_size

_MOST_FOV_DEG = 170  # above: K in other units, e.g. shares of the photo's width
_LEAST_FOCAL = 0.5 / math.tan(math.radians(_MOST_FOV_DEG) / 2)
_KEYS = ("fx", "fy", "cx", "cy")
_EXPECTED = (
    '{"fx": …, "fy": …, "cx": …, "cy": …} or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], in pixels, '
    "without skew and distortion"
)
_EXAMPLE = (
    'an object of cameras by name, {"kitchen/door": K, "hall": K}: of images as in images/ without '
    'ending, of folders, or "." of all'
)


@dataclass(frozen=True)
class FolderCameras:
    """Cameras of the photos in one folder.

    Attributes:
        path: Path of ``cameras.json``, which may be missing.
        given: Content of the file by name of an image or folder; ``.`` for all images.
        fov_deg: Horizontal field of view of all other photos; None to read it from EXIF data.
    """

    path: Path
    given: Mapping[str, Any]
    fov_deg: float | None

    @property
    def fingerprint(self) -> str:
        """Text that changes when the cameras of photos may change."""
        content = json.dumps([self.given, self.fov_deg], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def check_names(self, images: Sequence[ImageFiles], problems: Problems) -> None:
        """Note cameras that belong to no image.

        Args:
            images: All images of the data set.
            problems: Collects problems.
        """
        known = {place for files in images for place in _places(files)}
        for place in self.given.keys() - known:
            error = DataError(
                self.path,
                found=f"{place!r}, which is not an image or folder",
                expected=_EXAMPLE,
            )
            problems.add(error, f"{self.path.name}: {place}")

    def matrix(self, files: ImageFiles) -> NDArray[np.float64]:
        """Return the camera matrix of a photo.

        Args:
            files: Files of the photo.

        Returns:
            ``(3, 3)`` K of the photo as displayed (EXIF orientation applied) for integer pixel
            centers, from the entry of ``cameras.json`` for the photo or its nearest folder;
            otherwise from `fov_deg` or EXIF data, with the principal point in the middle.

        Raises:
            DataError: The camera is unknown, the entry does not fit the photo, or the photo cannot
                be read.
        """
        height, width = size = read_image_size(files.rgb)
        place = next((place for place in _places(files) if place in self.given), None)
        if place is None:
            return camera_matrix_from_fov(self._fov_deg(files.rgb), size)
        matrix = self._given_matrix(place)
        (fx, _, x), (_, fy, y), _ = matrix.tolist()
        inside = -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
        if not inside or min(fx / width, fy / height) < _LEAST_FOCAL:
            raise DataError(
                self.path,
                found=f"fx = {fx:g}, fy = {fy:g}, cx = {x:g}, cy = {y:g} for {files.name}",
                expected=f"pixels of the photo as displayed, {width} across and {height} down: a "
                f"principal point inside, a field of view below {_MOST_FOV_DEG}°",
                remedy="Scale K if the photo was resized; rotate it if EXIF data rotate the photo.",
            )
        return matrix

    def _given_matrix(self, place: str) -> NDArray[np.float64]:
        given = rows = self.given[place]
        if isinstance(given, dict) and given.keys() == set(_KEYS):
            fx, fy, cx, cy = (given[key] for key in _KEYS)
            rows = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        try:
            matrix = np.array(rows, np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if not is_camera_matrix(matrix):
            found = f"{place!r}: {json.dumps(given)}"
            raise DataError(self.path, found=found, expected=_EXPECTED)
        return matrix

    def _fov_deg(self, path: Path) -> float:
        fov_deg = photo_fov_deg(path) if self.fov_deg is None else self.fov_deg
        if fov_deg is None:
            raise DataError(
                path,
                found="no K in cameras.json, no data.fov and no focal length in its EXIF data",
                expected="one of the three",
                remedy="Name it or its folder in cameras.json, give data.fov=<horizontal field of "
                "view in degrees> (65 to 80 for most phones), or copy the original with its EXIF "
                "data.",
            )
        return fov_deg


def read_folder_cameras(path: Path, fov_deg: float | None) -> FolderCameras:
    """Read a ``cameras.json``; each camera is checked when its photo is read.

    It holds K by name of an image, e.g. ``kitchen/door``, or of a folder, for all its images that
    have no closer entry; ``.`` or an empty name stands for all images::

        {"kitchen/door": [[1400, 0, 959.5], [0, 1400, 539.5], [0, 0, 1]],
         "hall": {"fx": 1380, "fy": 1380, "cx": 959.5, "cy": 539.5}}

    Args:
        path: File, which may be missing.
        fov_deg: Horizontal field of view of all other photos, see `FolderCameras`.

    Raises:
        DataError: The file cannot be read, or has another content.
    """
    content = read_json(path, _EXAMPLE) if os.path.lexists(path) else {}
    if not isinstance(content, dict):
        raise DataError(path, found=json.dumps(content), expected=_EXAMPLE)
    given = {PurePosixPath(composed(name)).as_posix(): value for name, value in content.items()}
    if len(given) < len(content):
        raise DataError(path, found="one name written in two ways", expected="every name once")
    return FolderCameras(path, given, fov_deg)


def _places(files: ImageFiles) -> list[str]:
    """Return the name of an image and its folders, from the nearest to ``.``."""
    name = PurePosixPath(files.name)
    return [place.as_posix() for place in (name, *name.parents)]
