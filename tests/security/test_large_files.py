"""Small files that promise much: images, packed text, XML and JSON."""

from __future__ import annotations

import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageFile

from datamodules.core.label_table import LabelTable
from datamodules.folder.classes import read_classes
from datamodules.images import pixel_files, png
from datamodules.images.gpano import NAMESPACE
from datamodules.images.image_files import read_array, read_depth_m, read_rgb
from datamodules.images.image_opening import MOST_PIXELS
from datamodules.images.pixel_files import read_pixels, write_pixels
from datamodules.images.png import read_color_png, read_depth_png
from datamodules.images.xmp import read_xmp_tags
from tangent_train.errors import DataError, SettingError
from tangent_train.rendering.camera_files import read_cameras

Read = Callable[[Path], Any]


def _pixels(path: Path) -> Any:
    return read_pixels(path, indices=True)


def _depth(path: Path) -> Any:
    return read_depth_m(path, 1000)


def _png(path: Path, width: int, height: int, bits: int = 16, color: int = 0) -> Path:
    def chunk(name: bytes, content: bytes) -> bytes:
        checked = name + content
        return struct.pack(">I", len(content)) + checked + struct.pack(">I", zlib.crc32(checked))

    header = struct.pack(">IIBBBBB", width, height, bits, color, 0, 0, 0)
    parts = [
        chunk(b"IHDR", header),
        chunk(b"IDAT", zlib.compress(bytes(1000))),
        chunk(b"IEND", b""),
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


def _tiff(path: Path, width: int, height: int) -> Path:
    """Three 32-bit floats a pixel, which Pillow does not know."""
    tags = [
        (256, 4, 1, width),
        (257, 4, 1, height),
        (258, 3, 1, 32),
        (259, 3, 1, 1),
        (262, 3, 1, 2),
        (273, 4, 1, 8),
        (277, 3, 1, 3),
        (278, 4, 1, height),
        (279, 4, 1, 12 * width * height % 2**32),
        (339, 3, 1, 3),
    ]
    entries = b"".join(struct.pack("<HHII", *tag) for tag in tags)
    content = struct.pack("<2sHI", b"II", 42, 8) + struct.pack("<H", len(tags)) + entries
    path.write_bytes(content + bytes(4))
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
    message = r"bomb\.png: found .*; expected at most 536870912 pixels\. .*set TANGENT_MOST_PIXELS"
    with pytest.raises(DataError, match=message):
        read(path)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_the_limit_is_a_setting(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"a{suffix}"
    image = np.arange(8 * 16, dtype=np.uint16).reshape(8, 16)
    write_pixels(path, image)
    readers: tuple[Read, ...] = (_pixels, _depth)
    readers += (read_depth_png,) if suffix == ".png" else ()
    for read in readers:
        monkeypatch.setenv(MOST_PIXELS, "127")
        with pytest.raises(DataError, match=r"found 8×16 pixels; expected at most 127 pixels"):
            read(path)
        monkeypatch.setenv(MOST_PIXELS, "128")
        assert read(path).shape == (8, 16)
    for wrong in ("", "0", "-1", "many", "1e9"):
        monkeypatch.setenv(MOST_PIXELS, wrong)
        with pytest.raises(SettingError, match=f"{MOST_PIXELS}: found '{wrong}'; expected a whole"):
            _pixels(path)


def test_more_can_be_allowed_than_is_by_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _png(tmp_path / "a.png", 32770, 16384, 1)
    monkeypatch.setenv(MOST_PIXELS, str(2**30))
    with path.open("ab") as file:
        file.write(bytes(100_000))
    # Past the limit, and then found to be broken.
    with pytest.raises(DataError, match=r"a\.png: found (a broken PNG|no image that can be)"):
        read_rgb(path)


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("read", [read_color_png, read_depth_png, _pixels, _depth, read_rgb])
def test_a_png_is_not_decoded_that_is_too_short_for_its_pixels(read: Read, tmp_path: Path) -> None:
    """Decoders take the memory for what the header says, here a gigabyte, before they look."""
    path = _png(tmp_path / "a.png", 30000, 15000)
    with pytest.raises(DataError, match=r"header of 15000×30000 pixels, and \d+ bytes; expected 8"):
        read(path)


def test_the_shortest_png_is_read(tmp_path: Path) -> None:
    """Of one colour, one bit a pixel: no image is packed closer."""
    path = tmp_path / "a.png"
    Image.new("1", (16384, 8192)).save(path, optimize=True)
    assert read_rgb(path).shape == (8192, 16384, 3)
    Image.new("RGB", (4096, 2048)).save(path, optimize=True)
    assert read_color_png(path).shape == (2048, 4096, 3)


def test_only_png_files_reach_the_decoder_of_png_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []
    for module in (png, pixel_files):
        monkeypatch.setattr(module, "decoded", lambda content, _: seen.append(content.size))
    for suffix in (".jpg", ".bmp", ".jp2", ".hdr"):
        kind = np.float32 if suffix == ".hdr" else np.uint8
        done, content = cv2.imencode(suffix, np.zeros((64, 64, 3), kind))
        assert done
        path = tmp_path / "a.png"
        path.write_bytes(content.tobytes())
        with pytest.raises(DataError):
            read_color_png(path)
    assert seen == []


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


def _in_limit(start: float) -> None:
    assert time.monotonic() - start < 20


def test_xmp_of_many_lines_is_read_in_time(tmp_path: Path) -> None:
    """Adding line to line would copy 4 MB two million times."""
    text = b"a\n" * 2_000_000
    xmp = b'<x xmlns:g="%s"><g:Name>%s</g:Name></x>' % (NAMESPACE.encode(), text)
    start = time.monotonic()
    tags = read_xmp_tags(_xmp(tmp_path / "a.webp", xmp), NAMESPACE)
    assert tags == {"Name": text.decode().strip()}
    _in_limit(start)


def test_xmp_without_end(tmp_path: Path) -> None:
    start = time.monotonic()
    path = _xmp(tmp_path / "a.webp", b"<a>" * 300_000)
    assert read_xmp_tags(path, NAMESPACE) == {}
    _in_limit(start)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_not_expanded(encoding: str, tmp_path: Path) -> None:
    """A billion laughs: a kilobyte that stands for gigabytes."""
    entities = '<!ENTITY a0 "ha">'
    entities += "".join(f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 10))
    inside = f'<x xmlns:g="{NAMESPACE}"><g:Name>&a9;</g:Name></x>'
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    laughs = f"{head}<!DOCTYPE x [{entities}]>{inside}"
    path = _xmp(tmp_path / "a.webp", laughs.encode(encoding))
    with pytest.raises(DataError, match="document type declaration"):
        read_xmp_tags(path, NAMESPACE)


@pytest.mark.parametrize("read", [read_classes, read_cameras, LabelTable.from_json])
def test_json_without_end(read: Read, tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for text in ("[" * 200_000, '{"a":' * 200_000, "[" * 99_999 + "]" * 99_999):
        path.write_text(text)
        with pytest.raises(DataError, match=r"a\.json"):
            read(path)
    path.write_text("[" + "1" * 5000 + "]")  # more digits than Python takes
    with pytest.raises(DataError, match=r"a\.json"):
        read(path)
