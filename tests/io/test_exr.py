"""The files are written by OpenEXR's own package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from tangent_train.errors import DataError
from tangent_train.io.pixel_files import read_depth_m, read_image_size, read_pixels, read_rgb

_DEPTH = np.fromfunction(lambda row, column: (row // 8 + column % 12) / 4 + 0.5, (40, 96)).astype(
    np.float32
)


def _write(path: Path, channels: dict[str, Any], **header: Any) -> Path:
    plain = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(plain | header, channels).write(str(path))
    return path


def _window(left: int, top: int, right: int, bottom: int) -> tuple[Any, Any]:
    return np.array([left, top], np.int32), np.array([right, bottom], np.int32)


def _tiles() -> Any:
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    return tiles


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint32])
@pytest.mark.parametrize(
    "header",
    [
        {"compression": OpenEXR.NO_COMPRESSION},
        {"compression": OpenEXR.PIZ_COMPRESSION, "lineOrder": OpenEXR.DECREASING_Y},
        {"type": OpenEXR.tiledimage, "tiles": _tiles()},
    ],
)
def test_pixels_are_as_written(tmp_path: Path, header: Any, dtype: type[Any]) -> None:
    depth = _DEPTH.astype(dtype)
    path = _write(tmp_path / "ä (1).exr", {"Z": depth}, **header)
    read = read_pixels(path, indices=True)
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, depth)


def test_a_part_of_the_display_window_and_several_parts_are_refused(tmp_path: Path) -> None:
    windows = {"dataWindow": _window(0, 0, 95, 39), "displayWindow": _window(0, 0, 95, 47)}
    path = _write(tmp_path / "a.exr", {"Z": _DEPTH}, **windows)
    with pytest.raises(DataError, match="several parts, or a data window beside"):
        read_image_size(path)
    parts = [OpenEXR.Part({"name": name}, {"Z": _DEPTH}) for name in ("left", "right")]
    OpenEXR.File(parts).write(str(path))
    with pytest.raises(DataError, match="several parts, or a data window beside"):
        read_image_size(path)


_RGBA = [*"RGBA"]
_BLENDER = [f"L.{name}.{c}" for name in ("Combined", "Image") for c in "RGBA"]
_NORMAL = ["L.Normal.X", "L.Normal.Y", "L.Normal.Z"]


@pytest.mark.parametrize(
    ("others", "name"),
    [
        ([], "Y"),
        (_RGBA, "Z"),
        (_BLENDER, "L.Z"),
        ([*_BLENDER, *_NORMAL, "L.Mist.Z", "L.Denoising Depth.Z"], "L.Depth.Z"),
        ([*_NORMAL, "L.UV.U", "L.UV.V"], "L.Depth.V"),
        (["X", "Y", "Z"], "depth"),
    ],
)
def test_the_channel_of_depth_is_found(tmp_path: Path, others: list[str], name: str) -> None:
    channels: dict[str, Any] = {other: np.zeros((40, 96), np.float16) for other in others}
    path = _write(tmp_path / "a.exr", channels | {name: _DEPTH})
    np.testing.assert_array_equal(read_pixels(path, indices=True), _DEPTH)


@pytest.mark.parametrize(
    "names",
    [
        _RGBA,
        _NORMAL,
        [*_BLENDER, "L.Mist.Z"],
        *(["R"], ["mask"], ["L.Z"]),
        ["L.Depth.Z", "M.Depth.Z"],
        ["R", "G", "B", "Z", "right.R", "right.G", "right.B", "right.Z"],
    ],
)
def test_other_channels_are_refused_unless_named(tmp_path: Path, names: list[str]) -> None:
    channels = {name: np.float32(1 + number) * _DEPTH for number, name in enumerate(names)}
    path = _write(tmp_path / "a.exr", channels)
    with pytest.raises(DataError) as caught:
        read_depth_m(path, 1000)
    listed = str(caught.value).partition("depth_channel=: ")[2].split(", ")
    assert sorted(listed) == sorted(names)
    for number, name in enumerate(names):
        np.testing.assert_array_equal(
            read_depth_m(path, 1000, name), np.float32(1 + number) * _DEPTH
        )
    with pytest.raises(DataError, match="expected channel albedo"):
        read_depth_m(path, 1000, "albedo")


def test_colors_are_those_of_the_main_or_only_layer(tmp_path: Path) -> None:
    half = _DEPTH.astype(np.float16)
    channels: dict[str, Any] = {"L.Combined.R": half, "L.Combined.G": 2 * half}
    channels |= {"L.Combined.B": 3 * half, "L.Combined.A": half, "L.Depth.Z": _DEPTH}
    path = _write(tmp_path / "a.exr", channels)
    colors = read_pixels(path, indices=False)
    assert colors.dtype == np.float32
    np.testing.assert_array_equal(colors, np.stack([half, 2 * half, 3 * half], -1))
    with pytest.raises(DataError, match="expected colors of 8 or 16 bits"):
        read_rgb(path)
    path = _write(path, channels | {f"L.CryptoObject00.{c}": half for c in "rgb"})
    np.testing.assert_array_equal(read_pixels(path, indices=False), colors)
    bare = dict.fromkeys("RGB", _DEPTH) | {f"crypto00.{c}": half for c in "rgba"}
    path = _write(path, channels | bare)
    np.testing.assert_array_equal(read_pixels(path, indices=False), np.stack([_DEPTH] * 3, -1))
    path = _write(path, {f"{name}.{c}": half for name in ("L.N", "L.DiffCol") for c in "RGB"})
    with pytest.raises(DataError, match="expected one layer with the channels R, G and B"):
        read_pixels(path, indices=False)


def test_unsuitable_files(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    deep = np.empty((4, 3), object)
    for place in np.ndindex(4, 3):
        deep[place] = np.ones(1 + place[0], np.float32)
    _write(path, {"Z": deep}, type=OpenEXR.deepscanline, compression=OpenEXR.ZIPS_COMPRESSION)
    with pytest.raises(DataError, match=r"a\.exr: found .*several samples per pixel"):
        read_pixels(path, indices=True)
