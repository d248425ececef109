"""Panoramas that are a part of the sphere: which part, and their place on the whole of it.

Cameras and stitchers write it into the XMP data of an image, in the tags of Google's Photo Sphere
format (https://developers.google.com/streetview/spherical-metadata): the size the whole panorama
would have, and where in it the image lies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from datamodules.core.panoramas import resize_nearest
from datamodules.images.xmp import read_xmp_tags
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["NAMESPACE", "PanoramaArea", "area_of", "area_of_crop", "whole_area"]

_Pixel = TypeVar("_Pixel", bound=np.generic)

NAMESPACE = "http://ns.google.com/photos/1.0/panorama/"
"""Of all tags of the format."""

_SIZES = (
    "FullPanoWidthPixels",
    "FullPanoHeightPixels",
    "CroppedAreaImageWidthPixels",
    "CroppedAreaImageHeightPixels",
    "CroppedAreaLeftPixels",
    "CroppedAreaTopPixels",
)
_TOLERANCE = 0.02  # of pixels that should be square: angles and sizes are given in round numbers
_MOST_COLUMNS = 32768  # of the whole panorama, as of images that are one
_MOST_NUMBER = 1e9  # of pixels, of a tag that may be one
_SAY_IT = "Say with crop=[west,east,south,north] in degrees what the image shows."
_NOT_WHOLE = (
    "If it is a part of a panorama, say which with crop=[west,east,south,north] in degrees or with "
    "GPano tags in its XMP data; if it is a photo, choose projection=perspective."
)


@dataclass(frozen=True)
class PanoramaArea:
    """The place of an image on the sphere.

    Attributes:
        full_shape: Rows H and columns W = 2 H of the whole panorama.
        rows: First row of the image in it, and the one after its last.
        columns: The same of columns; the first is below W, the last may be beyond: such an image
            goes on at the left, across ±180°.
        image_shape: Rows and columns of the image itself: those of its place, or a little more or
            less where these were no whole numbers.
    """

    full_shape: tuple[int, int]
    rows: tuple[int, int]
    columns: tuple[int, int]
    image_shape: tuple[int, int]

    @property
    def is_whole(self) -> bool:
        """Whether the image is the whole panorama."""
        height, width = self.full_shape
        return self.rows == (0, height) and self.columns == (0, width)

    @property
    def known(self) -> NDArray[np.bool_]:
        """``(H, W)``: where the image is."""
        return self.place(np.ones(self.image_shape, np.bool_))

    def place(self, image: NDArray[_Pixel], fill: float = 0) -> NDArray[_Pixel]:
        """Lay the image onto the whole panorama.

        Args:
            image: ``(h, w[, C])``.
            fill: Value of all other pixels.

        Returns:
            ``(H, W[, C])``; the image itself if it is the whole panorama.

        Raises:
            ValueError: The image has another size.
        """
        self._check(image, self.image_shape)
        top, bottom = self.rows
        left, right = self.columns
        placed = resize_nearest(image, (bottom - top, right - left))
        if self.is_whole:
            return placed
        whole = np.full((*self.full_shape, *image.shape[2:]), fill, image.dtype)
        before = min(right, self.full_shape[1]) - left
        whole[top:bottom, left : left + before] = placed[:, :before]
        whole[top:bottom, : right - left - before] = placed[:, before:]
        return whole

    def cut(self, whole: NDArray[_Pixel]) -> NDArray[_Pixel]:
        """Take the image's part out of a whole panorama again; the inverse of `place`.

        Args:
            whole: ``(H, W[, C])``.

        Returns:
            ``(h, w[, C])``; may be a view.

        Raises:
            ValueError: The panorama has another size.
        """
        self._check(whole, self.full_shape)
        width = self.full_shape[1]
        left, right = self.columns
        part = whole[slice(*self.rows)]
        if right <= width:
            part = part[:, left:right]
        else:
            part = np.concatenate([part[:, left:], part[:, : right - width]], axis=1)
        return resize_nearest(part, self.image_shape)

    def places(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows ``(h,)`` and columns ``(w,)`` of the whole panorama that `cut` takes."""
        rows = np.arange(*self.rows)[:, None]
        columns = np.arange(*self.columns)[None] % self.full_shape[1]
        height, width = self.image_shape
        return resize_nearest(rows, (height, 1))[:, 0], resize_nearest(columns, (1, width))[0]

    @staticmethod
    def _check(image: NDArray[Any], shape: tuple[int, int]) -> None:
        if image.shape[:2] != shape:
            raise ValueError(f"an image of {image.shape[:2]} pixels; expected {shape}")


def area_of(path: Path, size: tuple[int, int]) -> PanoramaArea | None:
    """The place of an image by its own GPano tags.

    Images that were made smaller or larger after the tags were written are taken to show the same.

    Args:
        path: JPEG, PNG, TIFF or WebP.
        size: Its rows and columns.

    Returns:
        None where the image does not say, or not all.

    Raises:
        DataError: The file cannot be read, or the tags cannot be those of such an image.
    """
    tags = read_xmp_tags(path, NAMESPACE)
    projection = tags.get("ProjectionType", "equirectangular")
    if projection != "equirectangular":
        raise DataError(
            path,
            found=f"GPano:ProjectionType {projection}",
            expected="equirectangular",
            remedy="Export the panorama in that projection.",
        )
    if not all(name in tags for name in _SIZES):
        return None
    return _area_of_tags(path, size, [_number(path, name, tags[name]) for name in _SIZES])


def area_of_crop(size: tuple[int, int], crop: Sequence[float]) -> PanoramaArea:
    """The place of an image by the angles of its outer edges.

    Args:
        size: Its rows and columns.
        crop: West and east, −180 to 180; west is the greater one of an image across ±180°. South
            and north, −90 to 90. Degrees.

    Raises:
        SettingError: There is no such part, or the image would not have square pixels.
    """
    expected = "[west,east,south,north] in degrees, −180 to 180 and −90 to 90, south below north"
    if len(crop) != 4:
        raise SettingError("crop", found=list(crop), expected=expected)
    west, east, south, north = crop
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south < north <= 90):
        raise SettingError("crop", found=list(crop), expected=expected)
    width = east - west if east > west else east - west + 360
    if not 0 < width < 360 and (west, east) != (-180, 180):
        raise SettingError(
            "crop", found=list(crop), expected="east other than west; [-180,180,…] is all around"
        )
    pixels_deg = width / size[1], (north - south) / size[0]
    if not _agree(*pixels_deg):
        raise SettingError(
            "crop",
            found=f"{list(crop)}, pixels of {pixels_deg[0]:.4g}°×{pixels_deg[1]:.4g}° in an image "
            f"of {size[0]}×{size[1]}",
            expected="angles that make them square",
        )
    if size[1] * 360 / width > _MOST_COLUMNS:
        raise SettingError(
            "crop",
            found=f"{list(crop)} for an image of {size[0]}×{size[1]}",
            expected=f"a part of a panorama of at most {_MOST_COLUMNS} columns",
            remedy="Shrink the image, or take it as a photo (projection=perspective).",
        )
    return _area(
        size, ((west + 180) / 360, width / 360), ((90 - north) / 180, (north - south) / 180)
    )


def whole_area(path: Path, size: tuple[int, int]) -> PanoramaArea:
    """The place of an image that shows all of the sphere.

    Args:
        path: The image, for the message.
        size: Its rows and columns. One column too many or too few is allowed: programs that shrink
            images round so. It is left out, or its neighbour stands for it.

    Raises:
        DataError: It is not twice as wide as high.
    """
    height, width = size
    if abs(width - 2 * height) > 1 or width < 2:
        raise DataError(
            path,
            found=f"{height}×{width} pixels",
            expected="a whole panorama, twice as wide as high",
            remedy=_NOT_WHOLE,
        )
    return PanoramaArea((height, 2 * height), (0, height), (0, 2 * height), size)


def _area_of_tags(path: Path, size: tuple[int, int], tags: Sequence[int]) -> PanoramaArea:
    full_width, full_height, width, height, left, top = tags
    stated = (
        f"GPano tags of {height}×{width} pixels at ({top}, {left}) of {full_height}×{full_width}"
    )
    inside = 0 < width <= full_width and height > 0 and top >= 0 and top + height <= full_height
    if not inside or not _agree(full_width, 2 * full_height):
        raise DataError(
            path,
            found=stated,
            expected="a part of a panorama that is twice as wide as high",
            remedy=_SAY_IT,
        )
    if not _agree(size[1] / width, size[0] / height):
        raise DataError(
            path,
            found=f"{stated} in an image of {size[0]}×{size[1]}",
            expected="those of this image",
            remedy=f"It was cut after they were written. {_SAY_IT}",
        )
    if (width, height) == (full_width, full_height) and abs(size[1] - 2 * size[0]) <= 1:
        return whole_area(path, size)
    if size[1] / width * full_width > _MOST_COLUMNS:
        raise DataError(
            path,
            found=stated,
            expected=f"a part of a panorama of at most {_MOST_COLUMNS} columns",
            remedy="Shrink the image, or take it as a photo (projection=perspective).",
        )
    west = left % full_width / full_width
    return _area(size, (west, width / full_width), (top / full_height, height / full_height))


def _area(
    size: tuple[int, int], across: tuple[float, float], down: tuple[float, float]
) -> PanoramaArea:
    """The place of an image.

    Args:
        size: Its rows and columns.
        across: Its left edge and its width, as shares of the whole panorama's.
        down: Its upper edge and its height.
    """
    full_height = max(1, round(size[1] / across[1] / 2))
    rows = _span(down, full_height, size[0])
    first, end = _span(across, 2 * full_height, size[1])
    end = min(end, first + 2 * full_height)
    turns = first // (2 * full_height) * 2 * full_height
    bottom = min(rows[1], full_height)
    top = max(0, bottom - (rows[1] - rows[0]))
    return PanoramaArea(
        (full_height, 2 * full_height), (top, bottom), (first - turns, end - turns), size
    )


def _span(share: tuple[float, float], whole: int, pixels: int) -> tuple[int, int]:
    """First and end of a span that has its own number of pixels, if that is right within one."""
    first = round(share[0] * whole)
    exact = share[1] * whole
    count = pixels if abs(exact - pixels) < 1 else max(1, round(exact))
    return first, first + count


def _agree(one: float, other: float) -> bool:
    return abs(one - other) <= _TOLERANCE * max(one, other)


def _number(path: Path, name: str, text: str) -> int:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not abs(number) <= _MOST_NUMBER:
        raise DataError(
            path, found=f"GPano:{name} {text!r}", expected="a number of pixels", remedy=_SAY_IT
        )
    return round(number)
