"""GPano tags of cameras and stitchers: the part of the sphere that an image shows, and its pose.

The tags of Google's Photo Sphere format are stored in the XMP data of an image
(https://developers.google.com/streetview/spherical-metadata): the size of the whole panorama, the
position of the image in it, and the pitch and roll of the camera.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, Self, TypeVar
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.geometry.sphere import check_area
from tangent_train.io.pixel_files import read_xmp
from tangent_train.orientation.gravity import up_from_pose
from tangent_train.rendering.resampling import resize

_Pixel = TypeVar("_Pixel", bound=np.generic)

_RDF = "{http://www.w3.org/1999/02/22-rdf-syntax-ns#}RDF"
_NAMESPACES = (
    "http://ns.google.com/videos/1.0/spherical/",
    "http://ns.google.com/photos/1.0/panorama/",
)
PART_TAGS = (
    "FullPanoWidthPixels",
    "FullPanoHeightPixels",
    "CroppedAreaImageWidthPixels",
    "CroppedAreaImageHeightPixels",
    "CroppedAreaLeftPixels",
    "CroppedAreaTopPixels",
)
_TOLERANCE = 0.02  # tolerance of square pixels: angles and sizes are rounded
_MOST_COLUMNS = 32768  # columns of the whole panorama
_NOT_WHOLE = (
    "For a part of a panorama, give area=[west,east,south,north] in degrees, or GPano tags in its "
    "XMP data. For a photo, give fov=, its horizontal field of view in degrees; tangent-predict "
    "also needs projection=perspective. For a stereo panorama, two pictures above or beside each "
    "other, give eye=left or eye=right."
)
_SAME_AREA = (
    "All images of a data set show the same area: give data.area=[west,east,south,north] in degrees"
    " for a part of a panorama."
)

Eye = Literal["left", "right"]
"""Eye of a stereo panorama; the left one is at the top, or at the left, unless tags differ."""

_LAYOUTS = {"top-bottom": (2, 1), "left-right": (1, 2), "bottom-top": (2, 1), "right-left": (1, 2)}
"""Pictures below and beside each other by `StereoMode`, which names the left eye first."""
_MONO = ("", "mono")
_UNTAGGED = ("top-bottom", "left-right")

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


def read_area(
    path: Path,
    size: tuple[int, int],
    angles: Sequence[float] | None = None,
    remedy: str = _NOT_WHOLE,
    tags: Mapping[str, str] | None = None,
) -> PanoramaArea:
    """Return the part of the sphere that an image shows.

    It is between the angles of the image's outer edges; else by its GPano tags; else the whole
    sphere. Images resized after the tags were written are assumed to show the same area.

    Args:
        path: File; only JPEG, PNG, TIFF and WebP have tags.
        size: Rows and columns of the image.
        angles: West, east (−180 to 180; west > east for an image across ±180°), south and north
            (−90 to 90) in degrees; None to read the tags.
        remedy: Remedy for an image that is not a whole panorama.
        tags: Its tags; None to read them.

    Raises:
        DataError: The image would not have square pixels, the tags contradict it, or the whole
            panorama would be too large.
        SettingError: The angles are invalid.
    """
    west, east, south, north = check_area(angles)
    left, width = (west + 180) / 360, _width_deg(west, east) / 360
    top, height = (90 - north) / 180, (north - south) / 180
    shown = f"square pixels in area={[west, east, south, north]}"
    tags = {} if angles else read_tags(path) if tags is None else tags
    if tags.keys() >= set(PART_TAGS) or not _is_equirect(tags):
        shown = f"square pixels in the part of its GPano tags, {tags}"
        left, width, top, height = _tagged_part(tags)
    is_whole = width == height == 1
    if is_whole:
        shown = "a whole panorama, twice as wide as high"
    rows = size[1] * height / (2 * width)  # for square pixels
    is_square = abs(rows - size[0]) <= (0.5 if is_whole else size[0] * _TOLERANCE)
    if not (is_square and size[1] <= _MOST_COLUMNS * width):
        raise DataError(
            path,
            found=width_height(size),
            expected=f"{width_height((round(rows, 1), size[1]))}: {shown}; at most {_MOST_COLUMNS} "
            "columns around the sphere",
            remedy=remedy,
        )
    full_height = size[0] if is_whole else max(1, round(size[1] / width / 2))
    full_width = 2 * full_height
    exact = height * full_height
    rows = min(size[0] if abs(exact - size[0]) < 1 else max(1, round(exact)), full_height)
    first_row, first = min(round(top * full_height), full_height - rows), round(left * full_width)
    first, shown_columns = first % full_width, full_width if is_whole else min(size[1], full_width)
    bounds = (first_row, first_row + rows), (first, first + shown_columns)
    return PanoramaArea((full_height, full_width), *bounds, size)


def eye_part(
    path: Path,
    size: tuple[int, int],
    eye: Eye | None,
    angles: Sequence[float] | None,
    tags: Mapping[str, str],
) -> tuple[slice, slice]:
    """Return the rows and columns of an image that one eye sees.

    A stereo panorama has two pictures of the same size, below or beside each other, by its
    `StereoMode`; without it, in the layout in which they fit the area. Two whole panoramas are
    below each other in a square image, and beside each other in one four times as wide as high.

    Args:
        path: File, for messages.
        size: Rows and columns of the image.
        eye: The eye; None for an image that is not stereo.
        angles: See `read_area`.
        tags: Its tags.

    Raises:
        DataError: It is stereo and no eye is given, or the other way round.
    """
    if eye is None:
        refuse_stereo(path, tags)
        return slice(None), slice(None)
    stated = tags.get("StereoMode", "").lower()
    for layout in (stated,) if stated in _LAYOUTS else _UNTAGGED:
        rows, columns = (n // parts for n, parts in zip(size, _LAYOUTS[layout], strict=True))
        second = (eye == "right") == (layout in _UNTAGGED)
        top, left = (second * n % whole for n, whole in zip((rows, columns), size, strict=True))
        with suppress(DataError):
            read_area(path, (rows, columns), angles, tags=tags)
            return slice(top, top + rows), slice(left, left + columns)
    raise DataError(
        path,
        found=f"{width_height(size)}, {stated or 'without stereo metadata'}",
        expected=f"two pictures above or beside each other, for eye={eye}: each of a whole "
        "panorama, twice as wide as high, or of area=",
        remedy="Leave eye= out for a panorama of one picture.",
    )


def refuse_stereo(path: Path, tags: Mapping[str, str]) -> None:
    """Raise DataError if an image is stereo by its tags."""
    stated = tags.get("StereoMode", "").lower()
    if stated not in _MONO:
        raise DataError(
            path,
            found=f"a stereo panorama ({stated}), by its metadata",
            expected="one picture",
            remedy="Give eye=left or eye=right to use the picture of one eye. In data sets, cut it "
            "out, from labels and depth too, and remove the tag.",
        )


def shape_of(size: tuple[int, int], part: tuple[slice, slice]) -> tuple[int, int]:
    """Return rows and columns of a part of an image, see `eye_part`."""
    rows, columns = (len(range(n)[taken]) for n, taken in zip(size, part, strict=True))
    return rows, columns


def _is_equirect(tags: Mapping[str, str]) -> bool:
    return tags.get("ProjectionType", "equirectangular").lower() == "equirectangular"


def _tagged_part(tags: Mapping[str, str]) -> tuple[float, float, float, float]:
    """Return left edge, width, upper edge and height as fractions of the whole, by GPano tags.

    They are NaN if the tags are not those of a part of an equirectangular panorama.
    """
    full_width, full_height, width, height, left, top = (
        _number(tags.get(name, "")) for name in PART_TAGS
    )
    if math.isclose(full_width, full_height):  # of two pictures, below each other
        full_height, height, top = full_height / 2, height / 2, top / 2
    elif math.isclose(full_width, 4 * full_height):  # beside each other
        full_width, width, left = full_width / 2, width / 2, left / 2
    is_inside = 0 < width <= full_width and 0 <= top <= full_height - height < full_height
    if not (
        _is_equirect(tags)
        and is_inside
        and math.isfinite(left)
        and math.isclose(full_width, 2 * full_height, rel_tol=_TOLERANCE)
    ):
        return (math.nan,) * 4
    return (
        left / full_width,
        width / full_width,
        top / full_height,
        height / full_height,
    )


def check_resolution(
    path: Path, size: tuple[int, int], canvas: PanoramaArea, angles: Sequence[float] | None
) -> None:
    """Check that an image fits the area of its data set, and has enough pixels.

    Args:
        path: The image.
        size: Rows and columns of the image.
        canvas: The area, in pixels of the panoramas that a run reads.
        angles: The area in degrees; None for the whole sphere.

    Raises:
        DataError: Its pixels would not be square, or it is stereo by its tags.
        SettingError: It has fewer pixels.
    """
    refuse_stereo(path, read_tags(path))
    whole = check_area(angles) if angles is None else angles
    rows = read_area(path, size, whole, _SAME_AREA).full_shape[0]
    if size[1] < canvas.image_shape[1] - 1:
        raise SettingError(
            "representation.erp_height",
            found=canvas.full_shape[0],
            expected=f"at most {rows}, the rows of a whole panorama with the pixels of {path}",
            remedy=f"Set representation.erp_height={rows}, or a lower level if it is not set.",
        )


def black_outside(image: NDArray[_Pixel], valid: NDArray[np.bool_] | None) -> NDArray[_Pixel]:
    """Return a panorama ``(H, W[, C])`` that is 0 at invalid pixels."""
    if valid is None:
        return image
    mask = valid.reshape(valid.shape + (1,) * (image.ndim - 2))
    return np.where(mask, image, image.dtype.type(0))


def read_up(path: Path, tags: Mapping[str, str] | None = None) -> NDArray[np.float64] | None:
    """Return the up direction by the GPano tags of a panorama, see `up_from_pose`.

    Args:
        path: JPEG, PNG, TIFF or WebP.
        tags: Its tags; None to read them.

    Returns:
        ``(3,)`` unit vector in the panorama's frame. None without tags, or with pitch and roll 0,
        which programs write by default.

    Raises:
        DataError: A tag is not an angle.
    """
    tags = read_tags(path) if tags is None else tags
    pitch, roll = (_number(tags.get(f"Pose{name}Degrees", "0")) for name in ("Pitch", "Roll"))
    if not (abs(pitch) <= 90 and abs(roll) <= 180):
        raise DataError(
            path,
            found=f"GPano:PosePitchDegrees and PoseRollDegrees of {pitch} and {roll}",
            expected="numbers from −90 to 90 and from −180 to 180",
            remedy="Remove the tags, for example with exiftool -XMP-GPano:all= <file>.",
        )
    return None if pitch == roll == 0 else up_from_pose(pitch, roll)


def read_tags(path: Path) -> dict[str, str]:
    """Read the GPano and GSpherical tags of an image, see `tags_of`.

    Raises:
        DataError: The file cannot be read, or XMP data with this namespace are not XML.
    """
    return tags_of(path, read_xmp(path))


def tags_of(path: Path, packet: bytes) -> dict[str, str]:
    """Return the simple GPano and GSpherical properties in XMP data, by local name.

    A property may have any prefix, and may be an attribute or an element (XMP specification, part
    1). Properties of structures are ignored: they may describe another image. In videos the root
    itself has the properties (Google's Spherical Video V1).

    Args:
        path: File, for messages.
        packet: XMP data; may be empty.

    Raises:
        DataError: Data with this namespace are not XML.
    """
    packet = packet.strip(b"\0 \n")
    # A document type, which XMP does not have, could define entities that grow.
    if not any(name.encode() in packet for name in _NAMESPACES) or b"<!DOCTYPE" in packet:
        return {}
    try:
        root = ElementTree.fromstring(packet)
        nodes = [root, *(node for rdf in root.iter(_RDF) for node in rdf)]
    except (SyntaxError, ValueError) as error:
        raise DataError(
            path,
            found=f"XMP data that cannot be read ({error})",
            expected="XML",
            remedy="Write the tags again, or remove them: exiftool -XMP:all= <file>.",
        ) from error
    values: dict[str, str] = {}
    for node in nodes:
        values |= node.attrib | {child.tag: child.text or "" for child in node}
    return {
        name.removeprefix(start): value.strip()
        for start in (f"{{{namespace}}}" for namespace in _NAMESPACES)
        for name, value in values.items()
        if name.startswith(start)
    }


@lru_cache(maxsize=4)
def _valid(area: PanoramaArea) -> NDArray[np.bool_]:
    valid = area.place(np.ones(area.image_shape, np.bool_))
    valid.setflags(write=False)
    return valid


def _width_deg(west: float, east: float) -> float:
    return east - west if east > west else east - west + 360


def _number(text: str) -> float:
    """Return the number in a tag, NaN for other text."""
    try:
        return float(text)
    except ValueError:
        return math.nan
