"""Small files that claim to be large: images, arrays and XMP."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
from PIL import Image, ImageFile

from tangent_train.errors import DataError
from tangent_train.io.gpano import read_area
from tangent_train.io.pixel_files import read_depth_m, read_image_size, read_pixels, read_rgb
from tests.datamodules.data_files import png_chunk

Read = Callable[[Path], Any]


def _pixels(path: Path) -> Any:
    return read_pixels(path, indices=True)


def _depth(path: Path) -> Any:
    return read_depth_m(path, 1000)


def _png(path: Path, width: int, height: int) -> Path:
    """Write a file with 16 bits per pixel whose header has this size."""
    Image.new("I;16", (1, 1)).save(path, format="PNG")
    content = path.read_bytes()
    path.write_bytes(
        content[:8]
        + png_chunk(b"IHDR", struct.pack(">II", width, height) + content[24:29])
        + content[33:]
    )
    return path


@pytest.fixture
def no_decoder(monkeypatch: pytest.MonkeyPatch) -> None:
    def decode(*_: Any) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", decode)
    monkeypatch.setattr(ImageFile.ImageFile, "load", decode)


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("size", [(32769, 16384), (2**31 - 1, 2**31 - 1)])
@pytest.mark.parametrize("read", [_pixels, _depth, read_rgb])
def test_images_are_measured_before_they_are_decoded(
    read: Read, size: tuple[int, int], tmp_path: Path
) -> None:
    path = _png(tmp_path / "bomb.png", *size)
    with pytest.raises(
        DataError, match=r"bomb\.png: found .*(1 to 536870912 pixels|exceeds limit)"
    ):
        read(path)


def test_the_largest_panoramas_are_allowed(tmp_path: Path) -> None:
    assert read_image_size(_png(tmp_path / "a.png", 32768, 16384)) == (16384, 32768)


def test_long_xmp_with_a_document_type_is_ignored(
    tmp_path: Path,
) -> None:
    name = b"http://ns.google.com/photos/1.0/panorama/"
    laughs = b'<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>'
    inside = b'<x xmlns:GPano="%s"><GPano:FullPanoWidthPixels>%s' % (name, b"&b;\n" * 2_000_000)
    Image.new("RGB", (2, 1)).save(tmp_path / "a.webp", xmp=laughs + inside)
    with pytest.raises(DataError, match=r"a\.webp: found 2 × 4"):
        read_area(tmp_path / "a.webp", (4, 2))
