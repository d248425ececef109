"""Boxes of MP4 files in which Google's Spherical Video V1 and V2 state stereo mode and projection.

FFmpeg leaves out what it has no name for: of V2 meshes, and stereo modes other than one picture
above or to the left of the other; of V1 all but whole panoramas.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

_NESTED = dict.fromkeys((b"trak", b"mdia", b"minf", b"stbl", b"sv3d", b"proj"), 0) | {b"stsd": 8}
"""Boxes that contain others, after some bytes."""

_SAMPLE_ENTRY = 78
"""Bytes of a video sample entry before the boxes in it."""

_V1 = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
"""Name of the box ``uuid`` with the XML of V1."""

_PROJECTIONS = (b"prhd", b"equi", b"cbmp")
"""Boxes of a projection that FFmpeg reads."""

_STEREO_MODES = {0: "mono", 1: "top-bottom", 2: "left-right", 4: "right-left"}


class SphericalBoxes(NamedTuple):
    """Spherical metadata in the boxes of an MP4 file.

    Attributes:
        mode: Stereo mode by the names of `StereoMode`, or its number; None without a box ``st3d``.
        projection: Name of a projection that FFmpeg does not read, such as ``mshp``, a mesh; or "".
        xml: XML of V1; empty without V1, or beside V2.
    """

    mode: str | None = None
    projection: str = ""
    xml: bytes = b""


def spherical_boxes(path: Path) -> SphericalBoxes:
    """Read the boxes of an MP4 file; nothing is stated by other files."""
    found, is_v2 = SphericalBoxes(), False
    for parent, name, content in _boxes(_moov(path), b"moov"):
        is_v2 |= name == b"sv3d"
        if name == b"st3d" and len(content) > 4:
            mode = _STEREO_MODES.get(content[4], f"mode {content[4]}")
            found = found._replace(mode=mode)
        elif parent == b"proj" and name not in _PROJECTIONS:
            found = found._replace(projection=name.decode("latin-1"))
        elif name == b"uuid" and content.startswith(_V1):
            found = found._replace(xml=content.removeprefix(_V1))
    return found._replace(xml=b"") if is_v2 else found


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


def _boxes(data: bytes, parent: bytes) -> Iterator[tuple[bytes, bytes, bytes]]:
    """Yield parent, name and content of all boxes in the content of another."""
    start = 0
    while start + 8 <= len(data):
        size, name = struct.unpack_from(">I4s", data, start)
        if size < 8:
            return
        content = data[start + 8 : start + size]
        yield parent, name, content
        skipped = _SAMPLE_ENTRY if parent == b"stsd" else _NESTED.get(name)
        if skipped is not None:
            yield from _boxes(content[skipped:], name)
        start += size
