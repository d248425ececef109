"""Readers of prepared stores; valid files to break, what has to come out."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from datamodules.core.panoramas import Panorama
from datamodules.core.store_files import open_stored, write_stored
from datamodules.modelnet40.shape_files import ShapeFile
from datamodules.modelnet40.sphere_files import is_current, read_sphere
from datamodules.modelnet40.sphere_store import SphereFolder
from tests.slow.fuzz.pixels import DEPTH, RGB, SHAPE, npy

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "npy_part",
    "read_spheres",
    "read_store",
    "sphere_seeds",
    "store_part",
    "store_seeds",
]


def store_seeds() -> list[bytes]:
    made_from = {"files": {"rgb": "a.png (3 bytes of 4 ns)"}, "settings": {"mask": "labels"}}
    seeds = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.panorama"
        for depth in (None, DEPTH):
            write_stored(path, Panorama(RGB, depth, RGB[..., 0] % 14), made_from)
            seeds.append(path.read_bytes())
    return seeds


def store_part(content: bytes) -> tuple[bytes, Callable[[bytes], bytes]] | None:
    length = int.from_bytes(content[12:16], "little")
    pixels = content[-(-(20 + length) // 4096) * 4096 :]

    def put(text: bytes) -> bytes:
        head = content[:12] + struct.pack("<II", len(text), zlib.crc32(text)) + text
        return head + bytes(-len(head) % 4096) + pixels

    return content[20 : 20 + length], put


def read_store(path: Path) -> None:
    stored = open_stored(path)
    height, width = stored.panorama.labels.shape
    assert stored.panorama.rgb.shape == (height, width, 3)
    assert stored.panorama.rgb.dtype == stored.panorama.labels.dtype == np.uint8
    if stored.panorama.depth is not None:
        assert stored.panorama.depth.shape == (height, width)
        assert stored.panorama.depth.dtype == np.uint16
    assert stored.label_counts.shape == (256,)
    assert all(
        isinstance(name, str) and isinstance(value, str)
        for group in stored.made_from.values()
        for name, value in group.items()
    )
    stored.check_content()
    assert int(stored.panorama.rgb.sum()) >= 0  # every pixel can be looked at


def sphere_seeds() -> list[bytes]:
    steps = np.arange(8 * 16 * 6, dtype=np.uint16).reshape(*SHAPE, 6)
    entry = {"a/b": {"found": "a.off: found nothing", "stamp": "version 1 of 3 bytes of 4 ns"}}
    return [npy(steps) + b'\n{"made from": "version 1 of 3"}\n', json.dumps(entry).encode()]


def npy_part(content: bytes) -> tuple[bytes, Callable[[bytes], bytes]] | None:
    if not content.startswith(b"\x93NUMPY\1\0"):
        return None
    end = 10 + int.from_bytes(content[8:10], "little")

    def put(text: bytes) -> bytes:
        return content[:8] + struct.pack("<H", min(len(text), 65535)) + text[:65535] + content[end:]

    return content[10:end], put


def read_spheres(path: Path) -> None:
    is_current(path, path)
    if path.read_bytes()[:1] in (b"{", b"[", b'"'):
        listed = path.parent / "unusable.json"
        path.replace(listed)
        shapes = [ShapeFile(listed, "a/b", "a", "train")]
        try:
            assert len(SphereFolder(path.parent, SHAPE).usable(shapes)) in (0, 1)
        finally:
            listed.unlink()
        return
    steps = read_sphere(path, SHAPE)
    assert steps.shape == (*SHAPE, 6)
    assert steps.dtype == np.uint16
