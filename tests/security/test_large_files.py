"""Small files that claim to be large: images, arrays and XMP."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageFile

from datamodules.images.gpano import area_of
from datamodules.images.pixel_files import (
    read_array,
    read_depth_m,
    read_image_size,
    read_pixels,
    read_rgb,
)
from datamodules.images.png import read_color_png, read_depth_png
from tangent_train.errors import DataError
from tests.slow.fuzz.mutation import png_chunk

Read = Callable[[Path], Any]


def _pixels(path: Path) -> Any:
    return read_pixels(path, indices=True)


def _depth(path: Path) -> Any:
    return read_depth_m(path, 1000)


def _png(path: Path, width: int, height: int, bits: int = 16, color: int = 0) -> Path:
    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    parts = [
        png_chunk(b"IHDR", header),
        png_chunk(b"IDAT", zlib.compress(bytes(1000))),
        png_chunk(b"IEND", b""),
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


def _tiff(path: Path, width: int, height: int) -> Path:
    """Three times 16 bits a pixel, which OpenCV decodes."""
    tags = [
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 3, 8 + 2 + 10 * 12 + 4),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, 8),
        (277, 3, 1, 3),
        (278, 4, 1, height),
        (279, 4, 1, 6 * width * height % 2**32),
        (284, 3, 1, 1),
    ]
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    content = struct.pack("<2sHI", b"II", 42, 8) + struct.pack("<H", len(tags)) + entries
    path.write_bytes(content + bytes(4) + struct.pack("<3H", 16, 16, 16))
    return path


@pytest.fixture
def no_decoder(monkeypatch: pytest.MonkeyPatch) -> None:
    def decode(*_: Any) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", decode)
    monkeypatch.setattr(ImageFile.ImageFile, "load", decode)


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("size", [(60000, 60000), (32770, 16384), (2**31 - 1, 2**31 - 1)])
@pytest.mark.parametrize(
    ("read", "make"),
    [
        (read_color_png, _png),
        (read_depth_png, _png),
        (_pixels, _png),
        (_pixels, _tiff),
        (_depth, _png),
        (read_rgb, _png),
    ],
)
def test_images_are_measured_before_they_are_decoded(
    read: Read, make: Callable[[Path, int, int], Path], size: tuple[int, int], tmp_path: Path
) -> None:
    path = make(tmp_path / "bomb.png", *size)
    assert path.stat().st_size < 2000
    with pytest.raises(
        DataError, match=r"bomb\.png: found .*(1 to 536870912 pixels|exceeds limit)"
    ):
        read(path)


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("read", [read_color_png, _pixels])
def test_chunks_that_claim_gigabytes_are_not_decoded(read: Read, tmp_path: Path) -> None:
    path = _png(tmp_path / "a.png", 16, 8)
    whole = path.read_bytes()
    path.write_bytes(whole[:33] + struct.pack(">I", 3_000_000_000) + whole[37:])
    with pytest.raises(DataError, match=r"a\.png: found .* truncated"):
        read(path)


def test_the_largest_panoramas_are_allowed(tmp_path: Path) -> None:
    assert read_image_size(_png(tmp_path / "a.png", 32768, 16384)) == (16384, 32768)


def test_arrays_are_not_made_larger_than_their_files(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.zeros((4, 8), np.float32))
    content = path.read_bytes()
    said, wanted = b"(4, 8), }", b"(400000000, 800000), }"
    forged = content.replace(said.ljust(len(wanted)), wanted)
    assert forged != content
    assert len(forged) == len(content)
    path.write_bytes(forged)
    with pytest.raises(DataError, match=r"a\.npy"):
        read_array(path)


def _xmp(path: Path, xmp: bytes) -> Path:
    Image.new("RGB", (2, 1)).save(path, xmp=xmp)
    return path


def test_long_xmp_is_read_in_part_and_entities_are_not_expanded(tmp_path: Path) -> None:
    name = b"http://ns.google.com/photos/1.0/panorama/"
    laughs = b'<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>'
    inside = b'<x xmlns:GPano="%s"><GPano:FullPanoWidthPixels>%s' % (name, b"&b;\n" * 2_000_000)
    path = _xmp(tmp_path / "a.webp", laughs + inside)
    assert area_of(path, (1, 2)).is_whole
