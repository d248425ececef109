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
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.geometry.sphere import check_area
from tangent_train.io.xmp import read_properties
from tangent_train.orientation.gravity import up_from_pose
from tangent_train.rendering.resampling import resize

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
_SAY_IT = "Give area=[west,east,south,north] in degrees: the part of the sphere that it shows."
_NOT_WHOLE = (
    "For a part of a panorama, give area=[west,east,south,north] in degrees, or GPano tags in its "
    "XMP data. For a photo, give fov=, its horizontal field of view in degrees; tangent-predict "
    "also needs projection=perspective."
)

Fill = Literal["black", "mean", "edge", "reflect"]
"""Colors of a panorama outside its area: black; the mean color of the image; its nearest edge
pixel; or the image, mirrored at its edges."""


@dataclass(frozen=True)
class PanoramaArea:
    """The part of the sphere that an image shows, in pixels of the whole panorama.

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

    @classmethod
    def on_canvas(cls, angles: Sequence[float] | None, rows: int, setting: str = "area") -> Self:
        """Return the pixels of an area, in a panorama of some rows.

        Args:
            angles: See `check_area`; size and position are rounded to pixels.
            rows: Rows H of the whole panorama.
            setting: Name of the setting, for messages.

        Raises:
            SettingError: The angles are not those of an area.
        """
        west, east, south, north = check_area(angles, setting)
        height = max(1, round((north - south) / 180 * rows))
        width = max(1, round(_width_deg(west, east) / 180 * rows))
        top = min(round((90 - north) / 180 * rows), rows - height)
        left = round((west + 180) / 180 * rows) % (2 * rows)
        bounds = (top, top + height), (left, left + width)
        return cls((rows, 2 * rows), *bounds, (height, width))

    @property
    def is_whole(self) -> bool:
        """True if the image is the whole panorama."""
        height, width = self.full_shape
        return self.rows == (0, height) and self.columns == (0, width)

    @property
    def valid(self) -> NDArray[np.bool_] | None:
        """``(H, W)`` True for the pixels of the image, read-only; None for the whole panorama."""
        return None if self.is_whole else _valid(self)

    def place(self, image: NDArray[_Pixel]) -> NDArray[_Pixel]:
        """Place the image ``(h, w[, C])`` on a panorama ``(H, W[, C])`` that is 0 elsewhere."""
        rows, columns = slice(*self.rows), np.arange(*self.columns) % self.full_shape[1]
        placed = resize(image, (self.rows[1] - self.rows[0], len(columns)), "nearest")
        if self.is_whole:
            return placed
        whole = np.zeros((*self.full_shape, *image.shape[2:]), image.dtype)
        whole[rows, columns] = placed
        return whole

    def filled(self, whole: NDArray[_Pixel], fill: Fill) -> NDArray[_Pixel]:
        """Return a panorama ``(H, W[, C])`` with its colors outside the area replaced."""
        if self.is_whole or fill == "black":
            return whole
        (top, bottom), (left, right) = self.rows, self.columns
        height, width = self.full_shape
        columns = np.arange(left, right) % width
        shown = whole[top:bottom, columns]
        if fill == "mean":
            filled = np.empty_like(whole)
            filled[:] = shown.mean(axis=(0, 1)).round()
            filled[top:bottom, columns] = shown
            return filled
        gap = width - (right - left)  # half of it is filled from either edge
        around = ((top, height - bottom), (gap // 2, gap - gap // 2), (0, 0))[: whole.ndim]
        padded = np.pad(shown, around, "edge" if fill == "edge" else "symmetric")
        return np.roll(padded, left - gap // 2, axis=1)

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
        return resize(rows, (height, 1), "nearest")[:, 0], resize(columns, (1, width), "nearest")[0]


def read_area(path: Path, size: tuple[int, int]) -> PanoramaArea:
    """Return the part of the sphere that an image shows: by `tagged_area`, else by `whole_area`.

    Args:
        path: JPEG, PNG, TIFF or WebP.
        size: Rows and columns of the image.

    Raises:
        DataError: The tags contradict the image, or it is not 2:1 and has no tags.
    """
    return tagged_area(path, size) or whole_area(path, size)


def tagged_area(path: Path, size: tuple[int, int]) -> PanoramaArea | None:
    """Return the part of the sphere that an image shows, by its GPano tags.

    Images resized after the tags were written are assumed to show the same area.

    Args:
        path: JPEG, PNG, TIFF or WebP.
        size: Rows and columns of the image.

    Returns:
        The area; None if tags are missing.

    Raises:
        DataError: The tags contradict the image.
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
        return None
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


def area_of_angles(size: tuple[int, int], angles: Sequence[float]) -> PanoramaArea:
    """Return the part of the sphere between the angles of an image's outer edges.

    Args:
        size: Rows and columns of the image.
        angles: West, east (−180 to 180; west > east for an image across ±180°), south and north
            (−90 to 90) in degrees.

    Raises:
        SettingError: The angles are invalid, or the image would not have square pixels.
        DataError: The whole panorama would be too large.
    """
    west, east, south, north = check_area(angles)
    width, height = _width_deg(west, east), north - south
    pixels_deg = width / size[1], height / size[0]
    if not math.isclose(*pixels_deg, rel_tol=_TOLERANCE):
        fit = pixels_deg[0] * size[0]
        raise SettingError(
            "area",
            found=f"{list(angles)}, pixels {pixels_deg[0]:.4g}° wide and {pixels_deg[1]:.4g}° high "
            f"in an image of {width_height(size)}",
            expected=f"angles that make them square: {fit:.2f}° high"
            + f", e.g. {-fit / 2:.2f} to {fit / 2:.2f}" * (fit <= 180),
        )
    across, down = ((west + 180) / 360, width / 360), ((90 - north) / 180, height / 180)
    return _area(f"area={list(angles)}", size, across, down)


def black_outside(image: NDArray[_Pixel], valid: NDArray[np.bool_] | None) -> NDArray[_Pixel]:
    """Return a panorama ``(H, W[, C])`` that is 0 at invalid pixels."""
    if valid is None:
        return image
    mask = valid.reshape(valid.shape + (1,) * (image.ndim - 2))
    return np.where(mask, image, image.dtype.type(0))


def check_area_size(
    path: Path, size: tuple[int, int], angles: Sequence[float], canvas: PanoramaArea
) -> None:
    """Check that an image fits the area of its data set, and has enough pixels.

    Args:
        path: The image.
        size: Rows and columns of the image.
        angles: The area, see `check_area`.
        canvas: The area, in pixels of the panoramas that a run reads.

    Raises:
        DataError: Its pixels would not be square.
        SettingError: It has fewer pixels.
    """
    height, width = canvas.image_shape
    west, east, south, north = angles
    ratio = (north - south) / _width_deg(west, east)
    if not math.isclose(size[0], size[1] * ratio, rel_tol=_TOLERANCE):
        raise DataError(
            path,
            found=width_height(size),
            expected=f"{width_height((round(size[1] * ratio), size[1]))}, for square pixels in "
            f"data.area={list(angles)}",
            remedy="Correct data.area; all images of a data set show the same area.",
        )
    if size[0] < height - 1 or size[1] < width - 1:
        rows = round(size[1] / width * canvas.full_shape[0])
        raise SettingError(
            "representation.erp_height",
            found=canvas.full_shape[0],
            expected=f"at most {rows}, the rows of a whole panorama with the pixels of {path}",
            remedy=f"Set representation.erp_height={rows}, or a lower level if it is not set.",
        )


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


@lru_cache(maxsize=4)
def _valid(area: PanoramaArea) -> NDArray[np.bool_]:
    valid = area.place(np.ones(area.image_shape, np.bool_))
    valid.setflags(write=False)
    return valid


def _width_deg(west: float, east: float) -> float:
    return east - west if east > west else east - west + 360


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
            remedy="Shrink the image, or use it as a photo.",
        )
    full_width = 2 * full_height
    left, width = round(across[0] * full_width) % full_width, min(size[1], full_width)
    exact = down[1] * full_height
    height = size[0] if abs(exact - size[0]) < 1 else max(1, round(exact))
    height = min(height, full_height)
    top = min(round(down[0] * full_height), full_height - height)
    return PanoramaArea((full_height, full_width), (top, top + height), (left, left + width), size)
