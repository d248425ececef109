from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from datamodules.images.png import PngHeader, read_color_png, read_depth_png, read_png_header
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path


def _write(path: Path, image: np.ndarray[Any, Any]) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize(
    ("shape", "dtype", "bits", "color"),
    [
        ((4, 8, 3), np.uint8, 8, "RGB"),
        ((4, 8, 4), np.uint8, 8, "RGBA"),
        ((4, 8), np.uint8, 8, "grey"),
        ((4, 8), np.uint16, 16, "grey"),
    ],
)
def test_header(tmp_path: Path, shape: tuple[int, ...], dtype: Any, bits: int, color: str) -> None:
    path = _write(tmp_path / "image.png", np.zeros(shape, dtype))
    assert read_png_header(path) == PngHeader(4, 8, bits, color)


def test_color_is_rgb_and_alpha_is_dropped(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (4, 8, 3), np.uint8)
    opaque = _write(tmp_path / "a.png", rgb[..., ::-1])
    transparent = _write(tmp_path / "b.png", np.dstack([rgb[..., ::-1], rgb[..., :1]]))
    for path in (opaque, transparent):
        np.testing.assert_array_equal(read_color_png(path), rgb)


def test_depth_keeps_16_bits(tmp_path: Path) -> None:
    depth = np.array([[0, 1, 255, 256], [511, 512, 65534, 65535]], np.uint16)
    read = read_depth_png(_write(tmp_path / "depth.png", depth))
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, depth)


@pytest.mark.parametrize("content", [b"", b"hello, not a picture at all......"])
def test_no_png(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "image.png"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"image\.png: found no PNG header"):
        read_png_header(path)
    with pytest.raises(DataError, match=r"image\.png: found a broken PNG"):
        read_color_png(path)


@pytest.mark.parametrize("missing", [slice(-20, None), slice(-1, None), slice(1000, 3000)])
def test_parts_are_missing(tmp_path: Path, missing: slice) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)
    path = _write(tmp_path / "image.png", noise)
    content = bytearray(path.read_bytes())
    del content[missing]
    path.write_bytes(content)
    with pytest.raises(DataError, match="parts missing"):
        read_png_header(path)
    with pytest.raises(DataError, match="broken PNG"):
        read_color_png(path)


@pytest.mark.parametrize("read", [read_png_header, read_color_png, read_depth_png])
def test_missing_file(tmp_path: Path, read: Any) -> None:
    with pytest.raises(DataError, match="No such file"):
        read(tmp_path / "image.png")
