"""GPano tags of cameras and stitchers: the part of the sphere that an image shows, and its pose.

The tags of Google's Photo Sphere format are stored in the XMP data of an image
(https://developers.google.com/streetview/spherical-metadata): the size of the whole panorama, the
position of the image in it, and the pitch and roll of the camera.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from datamodules.core.panoramas import resize_nearest
from datamodules.images.xmp import read_properties
from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.rendering.upright.gravity import up_from_pose

_Pixel = TypeVar("_Pixel", bound=np.generic)

_NAMESPACE = "http://ns.google.com/photos/1.0/panorama/"
_SIZES = (
    "FullPanoWidthPixels",
    "FullPanoHeightPixels",
    "CroppedAreaImageWidthPixels",
    "CroppedAreaImageHeightPixels",
    "CroppedAreaLeftPixels",
    "CroppedAreaTopPixels",
)
_REAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_TOLERANCE = 0.02  # tolerance of square pixels: angles and sizes are rounded
_MOST_COLUMNS = 32768  # columns of the whole panorama
_SAY_IT = "Give crop=[west,east,south,north] in degrees: the part of the sphere that it shows."
_NOT_WHOLE = (
    "If it is a part of a panorama, say which with crop=[west,east,south,north] in degrees or with "
    "GPano tags in its XMP data. Photos are for tangent-predict with projection=perspective."
)


@dataclass(frozen=True)
class PanoramaArea:
    """The part of the sphere that an image shows.

    Attributes:
        full_shape: Rows H and columns W = 2 H of the whole panorama.
        rows: First row of the image in the panorama, and the row after its last.
        columns: First column of the image, below W, and the column after its last; beyond W the
            image continues at the left, across ±180°.
        image_shape: Rows and columns of the image itself, which may differ from `rows` and
            `columns` by rounding.
    """

    full_shape: tuple[int, int]
    rows: tuple[int, int]
    columns: tuple[int, int]
    image_shape: tuple[int, int]

    @property
    def is_whole(self) -> bool:
        """True if the image is the whole panorama."""
        height, width = self.full_shape
        return self.rows == (0, height) and self.columns == (0, width)

    def place(self, image: NDArray[_Pixel]) -> NDArray[_Pixel]:
        """Place the image ``(h, w[, C])`` on a panorama ``(H, W[, C])`` that is 0 elsewhere."""
        rows, columns = slice(*self.rows), np.arange(*self.columns) % self.full_shape[1]
        placed = resize_nearest(image, (self.rows[1] - self.rows[0], len(columns)))
        if self.is_whole:
            return placed
        whole = np.zeros((*self.full_shape, *image.shape[2:]), image.dtype)
        whole[rows, columns] = placed
        return whole

    def cut(self, whole: NDArray[_Pixel]) -> NDArray[_Pixel]:
        """Cut the image ``(h, w[, C])`` out of a panorama ``(H, W[, C])``; inverse of `place`.

        A whole panorama is returned as it is.
        """
        if self.is_whole and self.image_shape == self.full_shape:
            return whole
        rows, columns = self.places()
        return whole[rows[:, None], columns]

    def places(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return rows ``(h,)`` and columns ``(w,)`` of the whole panorama that `cut` takes."""
        rows = np.arange(*self.rows)[:, None]
        columns = np.arange(*self.columns)[None] % self.full_shape[1]
        height, width = self.image_shape
        return resize_nearest(rows, (height, 1))[:, 0], resize_nearest(columns, (1, width))[0]


def read_area(path: Path, size: tuple[int, int]) -> PanoramaArea:
    """Return the part of the sphere that an image shows, by its GPano tags.

    Images resized after the tags were written are assumed to show the same area.

    Args:
        path: JPEG, PNG, TIFF or WebP.
        size: Rows and columns of the image.

    Returns:
        The whole sphere if tags are missing, see `whole_area`.

    Raises:
        DataError: The tags contradict the image, or it is not 2:1 and has no tags.
    """
    tags = read_properties(path, _NAMESPACE)
    projection = tags.get("ProjectionType", "equirectangular")
    if projection.lower() != "equirectangular":
        raise DataError(
            path,
            found=f"GPano:ProjectionType {projection}",
            expected="equirectangular",
            remedy="Export the panorama in that projection.",
        )
    if not all(name in tags for name in _SIZES):
        return whole_area(path, size)
    full_width, full_height, width, height, left, top = (
        _number(path, name, tags[name], 1e9) for name in _SIZES
    )
    inside = 0 < width <= full_width and height > 0 and top >= 0 and top + height <= full_height
    agree = partial(math.isclose, rel_tol=_TOLERANCE)
    if not (
        inside and agree(full_width, 2 * full_height) and agree(size[1] / width, size[0] / height)
    ):
        raise DataError(
            path,
            found=f"GPano tags of {width_height((height, width))}, {left:g} from the left and "
            f"{top:g} from the top of {width_height((full_height, full_width))}, in an image of "
            f"{width_height(size)}",
            expected="a part, shaped like this image, of a panorama twice as wide as high",
            remedy=f"The image may have been cut after they were written. {_SAY_IT}",
        )
    if (width, height) == (full_width, full_height) and abs(size[1] - 2 * size[0]) <= 1:
        return whole_area(path, size)
    west = left % full_width / full_width
    return _area(path, size, (west, width / full_width), (top / full_height, height / full_height))


def area_of_crop(size: tuple[int, int], crop: Sequence[float]) -> PanoramaArea:
    """Return the part of the sphere between the angles of an image's outer edges.

    Args:
        size: Rows and columns of the image.
        crop: West, east (−180 to 180; west > east for an image across ±180°), south and north
            (−90 to 90) in degrees.

    Raises:
        SettingError: The angles are invalid, or the image would not have square pixels.
        DataError: The whole panorama would be too large.
    """
    west, east, south, north = crop if len(crop) == 4 else (0, 0, 0, 0)
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south < north <= 90) or (
        (east - west) % 360 == 0 and (west, east) != (-180, 180)
    ):
        raise SettingError(
            "crop",
            found=list(crop),
            expected="[west,east,south,north] in degrees, −180 to 180 and −90 to 90, south below "
            "north, east other than west; [-180,180,…] is all around",
        )
    width = east - west if east > west else east - west + 360
    pixels_deg = width / size[1], (north - south) / size[0]
    if not math.isclose(*pixels_deg, rel_tol=_TOLERANCE):
        raise SettingError(
            "crop",
            found=f"{list(crop)}, pixels {pixels_deg[0]:.4g}° wide and {pixels_deg[1]:.4g}° high "
            f"in an image of {width_height(size)}",
            expected="angles that make them square",
        )
    across, down = ((west + 180) / 360, width / 360), ((90 - north) / 180, (north - south) / 180)
    return _area(f"crop={list(crop)}", size, across, down)


def whole_area(path: Path, size: tuple[int, int], remedy: str = _NOT_WHOLE) -> PanoramaArea:
    """Return the area of an image that shows the whole sphere.

    Args:
        path: Image, for the error message.
        size: Rows and columns of the image. One column too many is dropped, one too few is
            repeated: a rounding error of other programs.
        remedy: Remedy in the error message.

    Raises:
        DataError: The image is not twice as wide as high.
    """
    height, width = size
    if abs(width - 2 * height) > 1 or width < 2:
        raise DataError(
            path,
            found=width_height(size),
            expected="a whole panorama, twice as wide as high",
            remedy=remedy,
        )
    return PanoramaArea((height, 2 * height), (0, height), (0, 2 * height), size)


def read_up(path: Path) -> NDArray[np.float64] | None:
    """Return the up direction by the GPano tags of a panorama, see `up_from_pose`.

    Args:
        path: JPEG, PNG, TIFF or WebP.

    Returns:
        ``(3,)`` unit vector in the panorama's frame. None without tags, or with pitch and roll 0,
        which programs write by default.

    Raises:
        DataError: A tag is not an angle.
    """
    tags = read_properties(path, _NAMESPACE)
    pitch = _number(path, "PosePitchDegrees", tags.get("PosePitchDegrees", "0"), 90)
    roll = _number(path, "PoseRollDegrees", tags.get("PoseRollDegrees", "0"), 180)
    return None if pitch == roll == 0 else up_from_pose(pitch, roll)


def _number(path: Path, name: str, text: str, most: float) -> float:
    number = float(text) if _REAL.fullmatch(text) else math.nan
    if not abs(number) <= most:
        raise DataError(
            path,
            found=f"GPano:{name} {text!r}",
            expected=f"a number from −{most:g} to {most:g}",
            remedy=f"Remove the tag, for example with exiftool -XMP-GPano:{name}= <file>.",
        )
    return number


def _area(
    subject: object, size: tuple[int, int], across: tuple[float, float], down: tuple[float, float]
) -> PanoramaArea:
    """Return the area of an image.

    Args:
        subject: Subject of the error message.
        size: Rows and columns of the image.
        across: Left edge and width of the image, as fractions of the whole width.
        down: Upper edge and height, as fractions of the whole height.
    """
    full_height = max(1, round(size[1] / across[1] / 2))
    if 2 * full_height > _MOST_COLUMNS:
        raise DataError(
            subject,
            found=f"a part of a panorama of {2 * full_height} columns",
            expected=f"at most {_MOST_COLUMNS}",
            remedy="Shrink the image, or take it as a photo (projection=perspective).",
        )
    full_width = 2 * full_height
    left, width = round(across[0] * full_width) % full_width, min(size[1], full_width)
    exact = down[1] * full_height
    height = size[0] if abs(exact - size[0]) < 1 else max(1, round(exact))
    height = min(height, full_height)
    top = min(round(down[0] * full_height), full_height - height)
    return PanoramaArea((full_height, full_width), (top, top + height), (left, left + width), size)
