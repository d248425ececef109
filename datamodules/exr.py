"""Depth of OpenEXR files: plain scan-line images, as cameras of renderers write them.

OpenCV's wheels are made without OpenEXR, and only the ways of packing pixels that most programs
choose by themselves are wanted: none and ZIP. The format: https://openexr.com/en/latest/OpenEXRFileLayout.html
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tangent_train.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["read_exr", "read_exr_size"]

_MAGIC = b"\x76\x2f\x31\x01\x02"
_PIXELS: dict[int, np.dtype[Any]] = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
_COMPRESSIONS = {1: "RLE", 4: "PIZ", 5: "PXR24", 6: "B44", 7: "B44A", 8: "DWAA", 9: "DWAB"}
_ROWS_PER_CHUNK = {0: 1, 2: 1, 3: 16}
_PREFERRED = ("Z", "Y", "V", "R")
_MOST_PIXELS = 32768 * 16384
_EXPECTED = "an OpenEXR image in scan lines, not compressed or ZIP"
_REMEDY = "Save the depth so, or convert it to a float TIFF or .npy file."


@dataclass(frozen=True)
class _Header:
    """What the header says.

    Attributes:
        shape: Rows and columns.
        top: Number of the first row.
        channels: Type of the pixels of each, in the order of the file.
        compression: Number of the packing.
        end: Where the table of chunks begins.
    """

    shape: tuple[int, int]
    top: int
    channels: dict[str, np.dtype[Any]]
    compression: int
    end: int


def read_exr_size(path: Path) -> tuple[int, int]:
    """Rows and columns of an OpenEXR image, from its header.

    Raises:
        DataError: It cannot be read, or is packed in another way.
    """
    return _parse_header(path, _content(path)).shape


def read_exr(path: Path) -> NDArray[Any]:
    """Decode one channel of an OpenEXR image.

    Args:
        path: The file. Of several channels the one whose name ends in Z, Y, V or R, the earlier of
            these letters first.

    Returns:
        ``(H, W)`` of the type of the file: float32, float16 or uint32.

    Raises:
        DataError: It cannot be read, is broken, packed in another way, or no such channel is there.
    """
    content = _content(path)
    header = _parse_header(path, content)
    name = _choose_channel(path, list(header.channels))
    try:
        return _decode(content, header, name)
    except (struct.error, zlib.error, ValueError, OverflowError) as error:
        raise DataError(
            path, found=f"a broken file ({error})", expected=_EXPECTED, remedy=_REMEDY
        ) from error


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(path, found=error, expected="an OpenEXR file") from error


def _parse_header(path: Path, content: bytes) -> _Header:
    try:
        attributes, end = _attributes(content)
        header = _header(attributes, end)
    except (struct.error, ValueError, KeyError, IndexError) as error:
        raise DataError(
            path, found=f"no such header ({error})", expected=_EXPECTED, remedy=_REMEDY
        ) from error
    if header.compression not in _ROWS_PER_CHUNK:
        found = f"{_COMPRESSIONS.get(header.compression, 'unknown')} compression"
        raise DataError(path, found=found, expected=_EXPECTED, remedy=_REMEDY)
    return header


def _attributes(content: bytes) -> tuple[dict[bytes, bytes], int]:
    """All attributes by name, and where they end."""
    # Flags: 2 tiles, 8 deep pixels, 16 several parts; 4, long names, changes nothing here.
    if not content.startswith(_MAGIC) or content[5] & ~4:
        raise ValueError("another file, or tiles, deep pixels or several parts")
    attributes, position = {}, 8
    while content[position]:
        name_end = content.index(0, position)
        type_end = content.index(0, name_end + 1)
        (size,) = struct.unpack_from("<I", content, type_end + 1)
        begin = type_end + 5
        attributes[content[position:name_end]] = content[begin : begin + size]
        position = begin + size
    return attributes, position + 1


def _header(attributes: dict[bytes, bytes], end: int) -> _Header:
    left, top, right, bottom = struct.unpack("<4i", attributes[b"dataWindow"])
    shape = bottom - top + 1, right - left + 1
    if min(shape) < 1 or shape[0] * shape[1] > _MOST_PIXELS:
        raise ValueError(f"{shape[0]}×{shape[1]} pixels")
    compression = attributes[b"compression"][0]
    return _Header(shape, top, _channels(attributes[b"channels"]), compression, end)


def _channels(listed: bytes) -> dict[str, np.dtype[Any]]:
    channels: dict[str, np.dtype[Any]] = {}
    position = 0
    while listed[position]:
        end = listed.index(0, position)
        kind, columns, rows = struct.unpack_from("<I4x2I", listed, end + 1)
        if (columns, rows) != (1, 1):
            raise ValueError("channels of lower resolution")
        channels[listed[position:end].decode()] = _PIXELS[kind]
        position = end + 17
    return channels


def _choose_channel(path: Path, names: list[str]) -> str:
    if len(names) == 1:
        return names[0]
    for letter in _PREFERRED:
        # Renderers put the name of a layer first: "ViewLayer.Depth.Z".
        chosen = [name for name in names if name.rsplit(".", 1)[-1] == letter]
        if len(chosen) == 1:
            return chosen[0]
    raise DataError(
        path,
        found=f"channels {', '.join(names)}",
        expected="one channel, or just one called Z, Y, V or R",
        remedy="Save the depth alone.",
    )


def _decode(content: bytes, header: _Header, name: str) -> NDArray[Any]:
    height, width = header.shape
    row_bytes = width * sum(kind.itemsize for kind in header.channels.values())
    names = list(header.channels)
    before = width * sum(header.channels[other].itemsize for other in names[: names.index(name)])
    kind = header.channels[name]
    image = np.zeros(header.shape, kind)
    rows_per_chunk = _ROWS_PER_CHUNK[header.compression]
    count = -(-height // rows_per_chunk)
    for offset in struct.unpack_from(f"<{count}Q", content, header.end):
        number, size = struct.unpack_from("<iI", content, offset)
        top = number - header.top
        if top % rows_per_chunk or not 0 <= top < height:
            raise ValueError(f"row {number}")
        rows = min(rows_per_chunk, height - top)
        packed = content[offset + 8 : offset + 8 + size]
        unpacked = _unpack(packed, rows * row_bytes)
        pixels = unpacked.reshape(rows, row_bytes)[:, before : before + width * kind.itemsize]
        image[top : top + rows] = np.ascontiguousarray(pixels).view(kind)
    return image


def _unpack(packed: bytes, size: int) -> NDArray[np.uint8]:
    """The bytes of a chunk: ZIP holds differences of the even bytes, then of the odd ones."""
    if len(packed) == size:  # what packing does not make smaller is stored as it is
        return np.frombuffer(packed, np.uint8)
    differences = np.frombuffer(zlib.decompressobj().decompress(packed, size), np.uint8)
    halves = np.cumsum(differences, dtype=np.uint8) + _offsets(differences.size)
    if halves.size != size:
        raise ValueError("too few pixels")
    unpacked = np.empty(size, np.uint8)
    middle = (size + 1) // 2
    unpacked[0::2], unpacked[1::2] = halves[:middle], halves[middle:]
    return unpacked


def _offsets(size: int) -> NDArray[np.uint8]:
    """Every difference but the first is 128 too large: every other sum by 128."""
    return (np.arange(size) % 2 * 128).astype(np.uint8)
