"""Cameras of photos: ``cameras.json``, one field of view for all, or EXIF data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, PositiveFloat

from datamodules.core.files import ImageFiles
from tangent_train.errors import DataError
from tangent_train.files import read_json
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.io.image_files import composed
from tangent_train.io.pixel_files import photo_fov_deg, read_image_size

_Zero = Annotated[float, Field(ge=0, le=0)]
_One = Annotated[float, Field(ge=1, le=1)]
_Rows = tuple[
    tuple[PositiveFloat, _Zero, float],
    tuple[_Zero, PositiveFloat, float],
    tuple[_Zero, _Zero, _One],
]
_EXPECTED = (
    'an object of cameras by name of an image or folder: {"kitchen/door": {"fx": …, "fy": …, '
    '"cx": …, "cy": …}} or [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], in pixels of the photo as '
    'displayed, without skew; "." stands for all images'
)


class _Pinhole(BaseModel, extra="forbid"):
    """Focal lengths and principal point in pixels."""

    fx: PositiveFloat
    fy: PositiveFloat
    cx: float
    cy: float


@dataclass(frozen=True)
class FolderCameras:
    """Cameras of the photos in one folder.

    Attributes:
        path: Path of ``cameras.json``, which may be missing.
        matrices: ``(3, 3)`` K by name of an image or folder; ``.`` for all images.
        fov_deg: Horizontal field of view of all other photos; None to read it from EXIF data.
    """

    path: Path
    matrices: Mapping[str, Any]
    fov_deg: float | None

    def matrix(self, files: ImageFiles) -> NDArray[np.float64]:
        """Return the camera matrix of a photo.

        Args:
            files: Files of the photo.

        Returns:
            ``(3, 3)`` K of the photo as displayed (EXIF orientation applied) for integer pixel
            centers, from the entry of ``cameras.json`` for the photo or its nearest folder;
            otherwise from `fov_deg` or EXIF data, with the principal point in the middle.

        Raises:
            DataError: The camera is unknown or does not fit the photo.
        """
        height, width = size = read_image_size(files.rgb)
        name = PurePosixPath(files.name)
        places = (place.as_posix() for place in (name, *name.parents))
        matrix = next((self.matrices[p] for p in places if p in self.matrices), None)
        if matrix is None:
            return camera_matrix_from_fov(self._fov_deg(files.rgb), size)
        (fx, _, x), (_, fy, y), _ = matrix.tolist()
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            found = f"fx = {fx:g}, fy = {fy:g}, cx = {x:g}, cy = {y:g} for {files.name}"
            expected = f"a principal point inside {width} × {height} pixels"
            raise DataError(self.path, found=found, expected=expected)
        return np.asarray(matrix)

    def _fov_deg(self, path: Path) -> float:
        fov_deg = photo_fov_deg(path) if self.fov_deg is None else self.fov_deg
        if fov_deg is None:
            raise DataError(
                path,
                found="no K in cameras.json, no data.fov and no focal length in its EXIF data",
                expected="one of the three",
                remedy="Name it or its folder in cameras.json, or give data.fov=<horizontal field "
                "of view in degrees> (65 to 80 for most phones).",
            )
        return fov_deg


def read_folder_cameras(path: Path, fov_deg: float | None) -> FolderCameras:
    """Read a ``cameras.json``.

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
    kind = dict[str, _Pinhole | _Rows]
    cameras = read_json(path, _EXPECTED, kind=kind) if path.exists() else {}
    matrices = {}
    for name, k in cameras.items():
        rows = k if isinstance(k, tuple) else [[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]]
        matrices[PurePosixPath(composed(name)).as_posix()] = np.array(rows, np.float64)
    return FolderCameras(path, matrices, fov_deg)
