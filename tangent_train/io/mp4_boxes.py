"""Boxes of MP4 files in which Google's Spherical Video V2 states stereo mode and projection.

FFmpeg leaves out what it has no name for: meshes, and stereo modes other than one picture above or
to the left of the other.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

_NESTED = dict.fromkeys((b"trak", b"mdia", b"minf", b"stbl", b"sv3d", b"proj"), 0) | {b"stsd": 8}
"""Boxes that contain others, after some bytes."""

_SAMPLE_ENTRY = 78
"""Bytes of a video sample entry before the boxes in it."""

_STEREO_MODES = {0: "mono", 1: "top-bottom", 2: "left-right", 4: "right-left"}


def spherical_boxes(path: Path) -> tuple[str | None, bool]:
    """Return the stereo mode of an MP4 file, and True if its projection is a mesh.

    Returns:
        Mode by the names of `StereoMode`, or its number; None if the file has no box ``st3d``.
    """
    mode, is_mesh, moov = None, False, _moov(path)
    for name, content in _boxes(moov, b"moov"):
        if name == b"st3d" and len(content) > 4:
            mode = _STEREO_MODES.get(content[4], f"mode {content[4]}")
        is_mesh |= name == b"mshp"
    return mode, is_mesh


def _moov(path: Path) -> bytes:
    """Return the content of the box ``moov``, or no bytes."""
    with path.open("rb") as file:
        while len(header := file.read(8)) == 8:
            size, name = struct.unpack(">I4s", header)
            read = 8
            if size == 1:
                size, read = int.from_bytes(file.read(8), "big"), 16
            if name == b"moov":
                return file.read(size - read if size else -1)
            if size < read:  # the last box, or another format
                break
            file.seek(size - read, 1)
    return b""


def _boxes(data: bytes, parent: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield name and content of all boxes in the content of another."""
    start = 0
    while start + 8 <= len(data):
        size, name = struct.unpack_from(">I4s", data, start)
        if size < 8:
            return
        content = data[start + 8 : start + size]
        yield name, content
        skipped = _SAMPLE_ENTRY if parent == b"stsd" else _NESTED.get(name)
        if skipped is not None:
            yield from _boxes(content[skipped:], name)
        start += size
