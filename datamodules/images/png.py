"""PNG files: what their header promises, checked without decoding, and their pixels."""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import cv2
import numpy as np

from datamodules.images.image_opening import check_pixels
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = [
    "PngHeader",
    "check_panorama_size",
    "check_png",
    "check_png_end",
    "decoded",
    "read_color_png",
    "read_depth_png",
    "read_png",
    "read_png_header",
]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_START = _SIGNATURE + b"\x00\x00\x00\rIHDR"
_HEADER_BYTES = 26  # the signature, IHDR's length and name, then its first ten bytes
_COLOR_TYPES = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}
_REMEDY = "Copy or extract the file again."


class PngHeader(NamedTuple):
    """Size and pixel format of a PNG file."""

    height: int
    width: int
    bits: int
    color: str


def read_png_header(path: Path) -> PngHeader:
    """Read the header of a PNG file and follow its chunks to the end, decoding nothing.

    Args:
        path: The file.

    Raises:
        DataError: It cannot be read, is no PNG, or parts are missing.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_HEADER_BYTES)
            size = file.seek(0, os.SEEK_END)
            whole = _chunks_end(_reader(file)) == size
    except OSError as error:
        raise DataError(path, found=error, expected="a PNG file", remedy=_REMEDY) from error
    if len(start) < _HEADER_BYTES or not start.startswith(_START):
        raise DataError(path, found="no PNG header", expected="a PNG file", remedy=_REMEDY)
    if not whole:
        raise _cut_off(path, size)
    width, height, bits, color = struct.unpack(">IIBB", start[len(_START) :])
    return PngHeader(height, width, bits, _COLOR_TYPES.get(color, f"color type {color}"))


def check_png_end(path: Path) -> None:
    """Make sure that nothing is missing at the end of a file, if it is a PNG.

    What comes behind the end is no matter: some programs leave notes there.

    Raises:
        DataError: It is cut off, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(_SIGNATURE)) != _SIGNATURE:
                return
            size = file.seek(0, os.SEEK_END)
            end = _chunks_end(_reader(file))
    except OSError as error:
        raise DataError(path, found=error, expected="an image", remedy=_REMEDY) from error
    if end is None or end > size:
        raise _cut_off(path, size)


def _cut_off(path: Path, size: int) -> DataError:
    return DataError(
        path, found=f"{size} bytes, parts missing", expected="a whole PNG", remedy=_REMEDY
    )


def check_png(path: Path, bits: int, colors: Sequence[str]) -> PngHeader:
    """Read the header of a PNG file that has to be as a data set was released.

    Args:
        path: The file.
        bits: Per channel.
        colors: What `PngHeader.color` may be.

    Raises:
        DataError: It cannot be read, is no PNG, parts are missing, or it has other pixels.
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


def check_panorama_size(path: Path, size: tuple[int, int], erp_height: int) -> None:
    """Make sure that an image is a whole panorama of enough rows.

    Args:
        path: The image.
        size: Its rows and columns.
        erp_height: Rows that are wanted.

    Raises:
        DataError: It is not twice as wide as high.
        SettingError: It has fewer rows.
    """
    height, width = size
    if width != 2 * height:
        raise DataError(
            path,
            found=f"{height}×{width} pixels",
            expected="twice as wide as high",
            remedy="Only full 360°×180° panoramas can be used.",
        )
    if height < erp_height:
        raise SettingError(
            "representation.erp_height",
            found=erp_height,
            expected=f"at most the {height} rows of {path}",
            remedy="Choose a lower level, or larger panoramas.",
        )


def _reader(file: BinaryIO) -> Callable[[int], bytes]:
    def eight_bytes_at(position: int) -> bytes:
        file.seek(position)
        return file.read(8)

    return eight_bytes_at


def _chunks_end(eight_bytes_at: Callable[[int], bytes]) -> int | None:
    """Where the IEND chunk ends, following the lengths of the chunks; None if there is none."""
    position = 8
    while True:
        head = eight_bytes_at(position)
        if len(head) < 8 or not head[4:].isalpha():
            return None
        position += 12 + int.from_bytes(head[:4], "big")
        if head[4:] == b"IEND":
            return position


def read_color_png(path: Path) -> NDArray[np.uint8]:
    """Decode an 8-bit colour image, ``(H, W, 3)`` in RGB order; alpha is dropped.

    Raises:
        DataError: The file is broken.
    """
    return cv2.cvtColor(read_png(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def read_depth_png(path: Path) -> NDArray[np.uint16]:
    """Decode a 16-bit grey image, ``(H, W)``.

    Raises:
        DataError: The file is broken.
    """
    return read_png(path, cv2.IMREAD_ANYDEPTH)


def read_png(path: Path, flags: int) -> NDArray[Any]:
    """Decode a PNG file as OpenCV does: blue first.

    Args:
        path: The file.
        flags: Of `cv2.imdecode`.

    Raises:
        DataError: The file is broken, or too large to be decoded.
    """
    # Decoding from memory keeps "cannot open" and "cannot decode" apart, and any path works.
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise DataError(path, found=error, expected="a PNG file", remedy=_REMEDY) from error
    head = content[:_HEADER_BYTES].tobytes()
    image = None
    # Nothing else is given to the decoder, which knows more formats than are needed.
    if head.startswith(_START) and len(head) == _HEADER_BYTES:
        width, height = struct.unpack_from(">II", head, len(_START))
        check_pixels(path, height, width)
        image = decoded(content, flags)
    if image is None:
        raise DataError(path, found="a broken PNG", expected="one that decodes", remedy=_REMEDY)
    return image


def decoded(content: NDArray[np.uint8], flags: int) -> NDArray[Any] | None:
    """Pixels of an image as OpenCV decodes it: blue first; None where it cannot."""
    if content[: len(_SIGNATURE)].tobytes() == _SIGNATURE:
        # OpenCV would take as much memory as a chunk says it has bytes, up to 2 GB.
        end = _chunks_end(lambda position: content[position : position + 8].tobytes())
        if end is None or end > content.size:
            return None
    try:
        return cv2.imdecode(content, flags) if content.size else None
    except cv2.error:  # more pixels than OpenCV allows
        return None
