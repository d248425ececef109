"""PNG files by their headers, and the sizes that images may have."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tangent_train.errors import DataError, SettingError, width_height

MOST_PIXELS = 32768 * 16384
"""Pixels of an image, at most: a file of a few kilobytes can claim more than memory holds."""

_HEADER = struct.Struct(">16sIIBB")  # start; width, height, bits, color
_START = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
_COLOR_TYPES = {0: "gray", 2: "RGB", 3: "palette", 4: "gray with alpha", 6: "RGBA"}


class PngHeader(NamedTuple):
    """Size and pixel format of a PNG file."""

    height: int
    width: int
    bits: int
    color: str


def check_pixels(path: Path, height: int, width: int) -> None:
    """Refuse an image that is too large to be decoded, by the size its header claims.

    Raises:
        DataError: It has no pixels, or more than `MOST_PIXELS`.
    """
    if not 0 < height * width <= MOST_PIXELS:
        raise DataError(
            path,
            found=width_height((height, width)),
            expected=f"1 to {MOST_PIXELS} pixels",
            remedy="Shrink the image.",
        )


def read_png_header(path: Path) -> PngHeader:
    """Read the header of a PNG file; nothing is decoded.

    Raises:
        DataError: It cannot be read, is not a PNG file, or has too many pixels.
    """
    remedy = "Copy or extract the file again."
    try:
        with path.open("rb") as file:
            start = file.read(_HEADER.size)
    except OSError as error:
        raise DataError(path, found=error, expected="a PNG file", remedy=remedy) from error
    if not start.startswith(_START) or len(start) < _HEADER.size:
        raise DataError(path, found="no PNG header", expected="a PNG file", remedy=remedy)
    _, width, height, bits, color = _HEADER.unpack(start)
    check_pixels(path, height, width)
    return PngHeader(height, width, bits, _COLOR_TYPES.get(color, f"color type {color}"))


def check_png(path: Path, bits: int, colors: Sequence[str]) -> PngHeader:
    """Read the header of a PNG file whose pixel format is known.

    Args:
        path: The file.
        bits: Per channel.
        colors: Allowed values of `PngHeader.color`.

    Raises:
        DataError: See `read_png_header`, or the file has another pixel format.
    """
    header = read_png_header(path)
    if header.bits != bits or header.color not in colors:
        raise DataError(
            path,
            found=f"{header.bits}-bit {header.color}",
            expected=f"{bits}-bit {' or '.join(colors)}",
            remedy="Use the files as released; do not convert them.",
        )
    return header


def check_panorama_size(
    path: Path,
    size: tuple[int, int],
    erp_height: int,
    remedy: str = "Only full 360°×180° panoramas can be used.",
) -> None:
    """Check that an image is a full panorama of enough rows.

    Args:
        path: The image.
        size: Rows and columns of the image.
        erp_height: Rows needed.
        remedy: Remedy for a part of a panorama.

    Raises:
        DataError: It is not twice as wide as high.
        SettingError: It has fewer rows.
    """
    height, width = size
    if width != 2 * height:
        raise DataError(
            path,
            found=width_height(size),
            expected="twice as wide as high",
            remedy=remedy,
        )
    if height < erp_height:
        raise SettingError(
            "representation.erp_height",
            found=erp_height,
            expected=f"at most the {height} rows of {path}",
            remedy=f"Set representation.erp_height={height}, or a lower level if it is not set.",
        )
