"""Pixels of any kind of number, written and read as they are."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from datamodules.images.pixel_files import PIXEL_SUFFIXES, check_writable, read_pixels, write_pixels
from tangent_train.errors import DataError, SettingError


def _pixels(dtype: Any, *shape: int) -> Any:
    numbers = np.random.default_rng(0).random(shape)
    return (numbers * (1 if np.dtype(dtype).kind == "f" else 250)).astype(dtype)


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize(
    ("suffix", "dtype"),
    [
        (".png", np.uint8),
        (".png", np.uint16),
        (".tif", np.uint8),
        (".TIFF", np.uint16),
        (".tif", np.float32),
        (".npy", np.float16),
        (".npy", np.int64),
        (".npy", np.bool_),
    ],
)
def test_what_is_written_is_read(
    suffix: str, dtype: Any, channels: tuple[int, ...], tmp_path: Path
) -> None:
    pixels = _pixels(dtype, 7, 9, *channels)
    path = tmp_path / "new" / f"a (1){suffix}"
    write_pixels(path, pixels)
    again = read_pixels(path, indices=True)
    assert again.dtype == pixels.dtype
    np.testing.assert_array_equal(again, pixels)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_other_programs_see_the_same_colours(suffix: str, tmp_path: Path) -> None:
    pixels = _pixels(np.uint8, 7, 9, 3)
    write_pixels(tmp_path / f"a{suffix}", pixels)
    with Image.open(tmp_path / f"a{suffix}") as image:
        np.testing.assert_array_equal(np.asarray(image), pixels)


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".webp"])
def test_lossy_formats_keep_the_order_of_colours(suffix: str, tmp_path: Path) -> None:
    pixels = np.full((16, 16, 3), (200, 100, 20), np.uint8)
    write_pixels(tmp_path / f"a{suffix}", pixels)
    again = read_pixels(tmp_path / f"a{suffix}", indices=False)
    assert np.abs(again.astype(int) - pixels).max() < 8


def test_transparency_is_left_out(tmp_path: Path) -> None:
    colors = _pixels(np.uint8, 5, 6, 4)
    Image.fromarray(colors).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png", indices=True), colors[..., :3])
    Image.fromarray(colors[..., :2]).save(tmp_path / "grey.png")
    np.testing.assert_array_equal(read_pixels(tmp_path / "grey.png", indices=True), colors[..., 0])
    deep = _pixels(np.uint16, 5, 6, 4) * 255
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    np.testing.assert_array_equal(
        read_pixels(tmp_path / "deep.png", indices=True), deep[..., 2::-1]
    )


def test_palettes(tmp_path: Path) -> None:
    indices = np.arange(12, dtype=np.uint8).reshape(3, 4)
    image = Image.fromarray(indices)
    image = Image.frombytes("P", (4, 3), indices.tobytes())
    image.putpalette([value for k in range(12) for value in (k, 2 * k, 255 - k)])
    image.save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png", indices=True), indices)
    colors = read_pixels(tmp_path / "a.png", indices=False)
    np.testing.assert_array_equal(colors[2, 1], (9, 18, 246))


def test_one_channel_arrays_have_no_axis_for_it(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.ones((4, 5, 1)))
    assert read_pixels(tmp_path / "a.npy", indices=True).shape == (4, 5)


@pytest.mark.parametrize(
    ("suffix", "dtype", "channels", "message"),
    [
        (".bmp", np.uint8, 3, r"'\.bmp' at its end"),
        ("", np.uint8, 3, "'' at its end"),
        (".png", np.float32, 1, r"float32 pixels of 1 channel; expected .*\.tif.*\.npy"),
        (".jpg", np.uint16, 3, r"uint16 pixels of 3 channels; expected .*\.png"),
        (".tif", np.float64, 1, r"expected .*\.npy"),
        (".png", np.uint8, 2, r"expected .*\.npy"),
        (".tif", np.int32, 1, r"expected .*\.npy"),
    ],
)
def test_files_that_cannot_hold_the_pixels(
    suffix: str, dtype: Any, channels: int, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        check_writable(suffix, dtype, channels)
    check_writable(".npy", dtype, channels)


def test_sides_that_a_format_cannot_have(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"a\.webp"):
        write_pixels(tmp_path / "a.webp", np.zeros((2, 20000, 3), np.uint8))
    assert not list(tmp_path.iterdir())


def _npz() -> bytes:
    file = io.BytesIO()
    np.savez(file, a=np.ones(3))
    return file.getvalue()


def _npy(array: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.npy", b""),
        ("a.npy", b"no array"),
        ("a.npy", _npz()),
        ("a.npy", _npy(np.array([{}]))),
        ("a.npy", _npy(np.ones(4))),
        ("a.npy", _npy(np.ones((0, 4)))),
        ("a.npy", _npy(np.array([["a"]]))),
        ("a.png", b""),
        ("a.png", b"\x89PNG\r\n\x1a\n" + b"\0" * 16 + b"\x10\x02"),
        ("a.tif", b"II*\0\0\0\0\0"),
        ("a.jpg", b"no image"),
    ],
)
def test_broken_files(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=name):
        read_pixels(tmp_path / name, indices=True)


@pytest.mark.parametrize("suffix", [*PIXEL_SUFFIXES, ".exr"])
def test_missing_files(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=f"a{suffix}"):
        read_pixels(tmp_path / f"a{suffix}", indices=True)
