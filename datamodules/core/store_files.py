"""The files of a prepared store: one panorama each, decoded, to be looked at where it lies.

A file is a header, then the arrays of the panorama as they are in memory, each from the beginning
of a page of 4096 bytes::

    8 bytes   PANORAMA
    3 × 4     version, length of the JSON, its CRC-32 (little endian)
    JSON      {"arrays": {"rgb": {"dtype": "|u1", "shape": [H, W, 3], "offset": …}, "labels": …,
               "depth": … or left out}, "bytes": …, "crc32": of all that follows the header's pages,
               "label_counts": [256 numbers], "made_from": {…}}

They are mapped into memory, not read: rendering an image touches the pages that it looks at, and
processes share them. Why so and not otherwise is measured in docs/store.md.
"""

from __future__ import annotations

import json
import struct
import zlib
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from datamodules.core.panoramas import Panorama
from datamodules.core.sources import count_labels
from tangent_train.errors import DataError
from tangent_train.files import atomic_path
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["PAGE", "VERSION", "StoredPanorama", "open_stored", "write_stored"]

PAGE = 4096
"""Bytes to whose multiples arrays are aligned."""

VERSION = 1
"""Version of the format; files of others are made anew."""

_MAGIC = b"PANORAMA"
_NUMBERS = struct.Struct("<III")
_DTYPES: dict[str, np.dtype[Any]] = {
    "rgb": np.dtype(np.uint8),
    "labels": np.dtype(np.uint8),
    "depth": np.dtype("<u2"),
}
_MADE_WHOLE = "one that tangent-prepare made"
_REMEDY = (
    "Run tangent-prepare with the same settings (data.store=… and all of data and representation): "
    "it makes what is missing, broken or out of date, and nothing else."
)


class StoredPanorama(NamedTuple):
    """One file of a store, mapped.

    Attributes:
        path: The file.
        panorama: Read-only views of the file; depth is None where it has none.
        label_counts: ``(256,)`` pixels of every label.
        made_from: What the writer said it was made from.
        checksum: CRC-32 of the content.
        content: All bytes after the header.
    """

    path: Path
    panorama: Panorama
    label_counts: NDArray[np.int64]
    made_from: dict[str, dict[str, str]]
    checksum: int
    content: NDArray[np.uint8]

    def check_content(self) -> None:
        """Read all of it and compare the checksum.

        Raises:
            DataError: Something changed since it was written.
        """
        if zlib.crc32(self.content.data) != self.checksum:
            raise broken(self.path, "corrupted content (another checksum)", _MADE_WHOLE)


def broken(path: Path, found: str, expected: str) -> DataError:
    """The error about a file that has to be made anew."""
    return DataError(path, found=found, expected=expected, remedy=_REMEDY)


def write_stored(
    path: Path, panorama: Panorama, made_from: Mapping[str, Mapping[str, str]]
) -> None:
    """Write a panorama, whole or not at all.

    Args:
        path: The file.
        panorama: What goes into it.
        made_from: What it was made from: files and settings, by name.
    """
    arrays: dict[str, NDArray[Any]] = {
        name: np.ascontiguousarray(array, _DTYPES[name])
        for name, array in zip(Panorama._fields, panorama, strict=True)
        if array is not None
    }
    places, checksum, size = {}, 0, 0
    for name, array in arrays.items():
        places[name] = {"dtype": array.dtype.str, "shape": array.shape, "offset": size}
        size += array.nbytes
        checksum = zlib.crc32(bytes(_gap(size)), zlib.crc32(array.data, checksum))
        size += _gap(size)
    text = json.dumps(
        {
            "arrays": places,
            "bytes": size,
            "crc32": checksum,
            "label_counts": count_labels(panorama.labels).tolist(),
            "made_from": made_from,
        }
    ).encode()
    head = _MAGIC + _NUMBERS.pack(VERSION, len(text), zlib.crc32(text)) + text
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(head + bytes(_gap(len(head))))
        for array in arrays.values():
            file.write(array.data)
            file.write(bytes(_gap(array.nbytes)))


def open_stored(path: Path) -> StoredPanorama:
    """Map a file, after checking its header and its size.

    Args:
        path: The file.

    Raises:
        DataError: It is missing, cut off, corrupted in the header, or of another version.
    """
    try:
        mapped = np.asarray(np.memmap(path, np.uint8, "r"))
    except (OSError, ValueError) as error:  # ValueError: an empty file
        missing = isinstance(error, FileNotFoundError)
        found = "no such file" if missing else f"nothing to read ({error})"
        raise broken(path, found, "a panorama of the prepared store") from error
    start = len(_MAGIC) + _NUMBERS.size
    if mapped[: len(_MAGIC)].tobytes() != _MAGIC or mapped.size < start:
        raise broken(path, "another kind of file, or a corrupted one", _MADE_WHOLE)
    version, length, checksum = _NUMBERS.unpack(mapped[len(_MAGIC) : start].tobytes())
    if version != VERSION:
        raise broken(path, f"version {version}", f"version {VERSION}")
    text = mapped[start : start + length].tobytes()
    if zlib.crc32(text) != checksum:
        raise broken(path, "a corrupted or truncated header", _MADE_WHOLE)
    content = mapped[start + length + _gap(start + length) :]
    try:
        header = parse_json(text)
        if content.size == header["bytes"]:
            return _parse(path, header, content)
        expected = f"{header['bytes'] + mapped.size - content.size} bytes"
    # A checksum that fits does not say who wrote the header.
    except Exception as error:
        found = f"a header that tells other things ({type(error).__name__}: {error})"
        raise broken(path, found, _MADE_WHOLE) from error
    raise broken(path, f"{mapped.size} bytes (truncated)", expected)


def _parse(path: Path, header: dict[str, Any], content: NDArray[np.uint8]) -> StoredPanorama:
    """What the header tells; any error where it tells something else."""
    arrays = {name: _view(content, name, **place) for name, place in header["arrays"].items()}
    panorama = Panorama(arrays["rgb"], arrays.get("depth"), arrays["labels"])
    height, width = panorama.labels.shape
    sizes = {array.shape for name, array in arrays.items() if name != "rgb"}
    if panorama.rgb.shape != (height, width, 3) or len(sizes) != 1:
        raise ValueError("arrays of different sizes")
    counts = np.array(header["label_counts"], np.int64)
    if counts.shape != (256,):
        raise ValueError(f"{counts.size} label counts")
    made_from = {
        str(group): {str(name): str(value) for name, value in entries.items()}
        for group, entries in header["made_from"].items()
    }
    return StoredPanorama(path, panorama, counts, made_from, int(header["crc32"]), content)


def _view(
    content: NDArray[np.uint8], name: str, dtype: str, shape: list[int], offset: int
) -> NDArray[Any]:
    if dtype != _DTYPES[name].str:  # "O" would take the bytes of the file for addresses
        raise ValueError(f"{name} of type {dtype}")
    return np.ndarray(shape, _DTYPES[name], content, offset)


def _gap(size: int) -> int:
    """Bytes to the beginning of the next page."""
    return -size % PAGE
