"""Cameras of photos: ``cameras.json``, one field of view for all, or EXIF data."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Annotated

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


def photo_camera(
    cameras: Mapping[str, NDArray[np.float64]], files: ImageFiles, fov_deg: float | None
) -> NDArray[np.float64]:
    """Return the camera matrix of a photo.

    Args:
        cameras: Result of `read_folder_cameras`.
        files: Files of the photo.
        fov_deg: Horizontal field of view of other photos; None to read it from EXIF data.

    Returns:
        ``(3, 3)`` K of the photo as displayed (EXIF orientation applied) for integer pixel
        centers, of the photo or its nearest folder; otherwise from `fov_deg` or EXIF data, with the
        principal point in the middle.

    Raises:
        DataError: The camera is unknown or does not fit the photo.
    """
    height, width = size = read_image_size(files.rgb)
    name = PurePosixPath(files.name)
    places = (place.as_posix() for place in (name, *name.parents))
    matrix = next((cameras[place] for place in places if place in cameras), None)
    if matrix is None:
        fov_deg = fov_deg or photo_fov_deg(files.rgb)
        if fov_deg is None:
            raise DataError(
                files.rgb,
                found="no K in cameras.json, no data.fov and no focal length in its EXIF data",
                expected="one of the three",
                remedy="Name it or its folder in cameras.json, or give data.fov=<horizontal field "
                "of view in degrees> (65 to 80 for most phones).",
            )
        return camera_matrix_from_fov(fov_deg, size)
    x, y = matrix[:2, 2]
    if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
        expected = f"a principal point inside {width} × {height} pixels"
        raise DataError(files.rgb, found=f"cx = {x:g}, cy = {y:g}", expected=expected)
    return matrix


def read_folder_cameras(path: Path) -> dict[str, NDArray[np.float64]]:
    """Read a ``cameras.json``.

    It holds K by name of an image, e.g. ``kitchen/door``, or of a folder, for all its images that
    have no closer entry; ``.`` or an empty name stands for all images::

        {"kitchen/door": [[1400, 0, 959.5], [0, 1400, 539.5], [0, 0, 1]],
         "hall": {"fx": 1380, "fy": 1380, "cx": 959.5, "cy": 539.5}}

    Args:
        path: File, which may be missing.

    Returns:
        ``(3, 3)`` K by name of an image or folder; ``.`` for all images.

    Raises:
        DataError: The file cannot be read, or has another content.
    """
    kind = dict[str, _Pinhole | _Rows]
    cameras = read_json(path, _EXPECTED, kind=kind) if path.exists() else {}
    matrices = {}
    for name, k in cameras.items():
        rows = k if isinstance(k, tuple) else [[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]]
        matrices[PurePosixPath(composed(name)).as_posix()] = np.array(rows, np.float64)
    return matrices
