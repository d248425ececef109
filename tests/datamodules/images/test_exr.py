"""The files are written by OpenEXR's own package, which knows every way of packing pixels."""

from __future__ import annotations

import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from datamodules.images.exr import read_exr, read_exr_size
from datamodules.images.image_files import read_depth_m, read_depth_size
from tangent_train.errors import DataError

_COMPRESSIONS = {
    name.removesuffix("_COMPRESSION").lower(): compression
    for name, compression in OpenEXR.Compression.__members__.items()
    if name != "NUM_COMPRESSION_METHODS"
}
_UNPACKED = {"no"}
_SIZE = b"dataWindow\0box2i\0"  # then the length of what follows, 16
# 40 rows are three chunks of ZIP. Quarters of small numbers are the same in 16 and 24 bits, which
# some ways of packing leave of 32.
_DEPTH = np.fromfunction(lambda row, column: (row // 8 + column % 12) / 4 + 0.5, (40, 96)).astype(
    np.float32
)


def _write(path: Path, channels: dict[str, Any], **header: Any) -> Path:
    plain = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(plain | header, channels).write(str(path))
    return path


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint32])
@pytest.mark.parametrize("compression", _COMPRESSIONS)
def test_every_compression(tmp_path: Path, compression: str, dtype: type[Any]) -> None:
    depth = _DEPTH.astype(dtype)
    path = _write(tmp_path / "a.exr", {"Z": depth}, compression=_COMPRESSIONS[compression])
    read = read_exr(path)
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, depth)
    assert read_exr_size(path) == (40, 96)


@pytest.mark.parametrize("compression", sorted(set(_COMPRESSIONS) - _UNPACKED))
def test_the_compressions_are_tried_on_packed_pixels(tmp_path: Path, compression: str) -> None:
    # What would not become smaller is stored as it is, and would test nothing.
    depth = _DEPTH.astype(np.float16)  # B44 packs no others
    packed = _write(tmp_path / "a.exr", {"Z": depth}, compression=_COMPRESSIONS[compression])
    plain = _write(tmp_path / "b.exr", {"Z": depth}, compression=OpenEXR.NO_COMPRESSION)
    assert packed.stat().st_size < plain.stat().st_size


def test_tiles(tmp_path: Path) -> None:
    tiles = OpenEXR.TileDescription()
    tiles.xSize, tiles.ySize = 16, 16
    path = _write(tmp_path / "a.exr", {"Z": _DEPTH}, type=OpenEXR.tiledimage, tiles=tiles)
    np.testing.assert_array_equal(read_exr(path), _DEPTH)


def test_rows_and_columns_may_begin_anywhere(tmp_path: Path) -> None:
    window = (np.array([5, -7], np.int32), np.array([100, 32], np.int32))
    path = _write(tmp_path / "ä (1).exr", {"Z": _DEPTH}, dataWindow=window)
    np.testing.assert_array_equal(read_exr(path), _DEPTH)
    assert read_exr_size(path) == (40, 96)


def test_odd_sizes(tmp_path: Path) -> None:
    for shape in [(1, 1), (1, 7), (33, 1), (17, 5)]:
        depth = _DEPTH[: shape[0], : shape[1]].copy()
        path = _write(tmp_path / "a.exr", {"Z": depth})
        np.testing.assert_array_equal(read_exr(path), depth)
        assert read_exr_size(path) == shape


@pytest.mark.parametrize(
    ("others", "name"),
    [
        ([], "distance"),
        (["R", "G", "B", "A"], "Z"),
        (["L.R", "L.G", "L.B", "M.Normal.X"], "L.Depth.Z"),
        (["R", "G", "B", "V"], "Y"),
        (["R", "G"], "V"),
        (["G", "B"], "R"),
        (["a.Y", "b.Y"], "V"),
    ],
)
def test_the_channel_of_depth_is_found(tmp_path: Path, others: list[str], name: str) -> None:
    channels: dict[str, Any] = {other: np.zeros((40, 96), np.float16) for other in others}
    path = _write(tmp_path / "a.exr", channels | {name: _DEPTH})
    np.testing.assert_array_equal(read_exr(path), _DEPTH)


def test_depth(tmp_path: Path) -> None:
    stored, expected = _DEPTH.copy(), _DEPTH.copy()
    for place, missing in enumerate([np.inf, np.nan, 1e10, -1.0]):
        stored[place, place], expected[place, place] = missing, 0
    path = _write(tmp_path / "a.exr", {"Z": stored})
    np.testing.assert_array_equal(read_exr(path), stored)
    np.testing.assert_array_equal(read_depth_m(path, 1000), expected)
    assert read_depth_size(path) == (40, 96)


@pytest.mark.parametrize("names", [("a.Z", "b.Z"), ("G", "B"), ("Normal.X", "Normal.z")])
def test_no_one_channel_of_depth(tmp_path: Path, names: tuple[str, str]) -> None:
    path = _write(tmp_path / "a.exr", dict.fromkeys(names, _DEPTH))
    with pytest.raises(DataError, match=r"a\.exr: found channels .*; expected one channel, or"):
        read_exr(path)


def test_several_parts(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    parts = [OpenEXR.Part({"name": name}, {"Z": _DEPTH}) for name in ("left", "right")]
    OpenEXR.File(parts).write(str(path))
    for read in (read_exr, read_exr_size):
        with pytest.raises(DataError, match=r"a\.exr: found 2 parts; .* Save the depth alone"):
            read(path)


def test_several_depths_per_pixel(tmp_path: Path) -> None:
    deep = np.empty((4, 3), object)
    for place in np.ndindex(4, 3):
        deep[place] = np.ones(1 + place[0], np.float32)
    path = _write(
        tmp_path / "a.exr",
        {"Z": deep},
        type=OpenEXR.deepscanline,
        compression=OpenEXR.ZIPS_COMPRESSION,
    )
    for read in (read_exr, read_exr_size):
        with pytest.raises(DataError, match=r"a\.exr: found deep pixels.* Flatten the image"):
            read(path)


def test_a_channel_of_lower_resolution(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.exr", {"Z": _DEPTH})
    content = bytearray(path.read_bytes())
    # Behind the name: its type and a flag, of four bytes each, then the steps.
    steps = content.index(b"chlist\0") + 7 + 4 + len(b"Z\0") + 8
    assert struct.unpack_from("<2i", content, steps) == (1, 1)
    struct.pack_into("<2i", content, steps, 2, 4)
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"found channel Z with one pixel per 4 rows and 2 columns"):
        read_exr(path)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ((0, 0, 32767, 16384), "16385×32768 pixels; expected at most 536870912 pixels"),
        ((0, 0, 32767, 16383), "pixels that cannot be decoded; expected an OpenEXR image"),
        ((0, 0, -5, -5), ".*; expected an OpenEXR image"),
        ((-(2**31), -(2**31), 2**31 - 1, 2**31 - 1), ".*; expected an OpenEXR image"),
    ],
)
def test_impossible_sizes(tmp_path: Path, corners: tuple[int, ...], message: str) -> None:
    path = _write(tmp_path / "a.exr", {"Z": _DEPTH})
    content = bytearray(path.read_bytes())
    begin = content.index(_SIZE) + len(_SIZE) + 4
    struct.pack_into("<4i", content, begin, *corners)
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"a\.exr: found {message}"):
        read_exr(path)


@pytest.mark.parametrize("compression", ["no", "zip", "piz", "dwaa"])
def test_cut_files_are_explained_wherever_they_end(tmp_path: Path, compression: str) -> None:
    whole = _write(tmp_path / "a.exr", {"Z": _DEPTH}, compression=_COMPRESSIONS[compression])
    content = whole.read_bytes()
    path = tmp_path / "cut.exr"
    step = max(1, len(content) // 200)
    for end in [*range(0, len(content), step), len(content) - 1]:
        path.write_bytes(content[:end])
        with pytest.raises(DataError, match=r"cut\.exr: found"):
            read_exr(path)


@pytest.mark.parametrize("compression", ["zip", "piz"])
def test_damage_gives_pixels_or_an_explanation_and_nothing_else(
    tmp_path: Path, compression: str
) -> None:
    path = _write(tmp_path / "a.exr", {"Z": _DEPTH}, compression=_COMPRESSIONS[compression])
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    # All but the size, which has its own test: gigabytes of nothing would be decoded.
    size = whole.tobytes().index(_SIZE) + len(_SIZE) + 4
    places = np.delete(np.arange(whole.size), slice(size, size + 16))
    rng = np.random.default_rng(0)
    explained = 0
    for _ in range(300):
        damaged = whole.copy()
        damaged[rng.choice(places, 2)] = rng.integers(0, 256, 2)
        path.write_bytes(damaged.tobytes())
        try:
            assert read_exr(path).ndim == 2
        except DataError:
            explained += 1
    assert explained > 100


@pytest.mark.parametrize("content", [b"", b"\x76\x2f", b"\x89PNG\r\n\x1a\n" + bytes(99)])
def test_other_files(tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.exr"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"a\.exr: found a file of another kind"):
        read_exr(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["missing.exr", ""])
def test_missing_files_and_folders(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DataError, match=r"found .*(No such file|Is a directory)"):
        read_exr_size(tmp_path / name)
    assert capfd.readouterr() == ("", "")


def test_the_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _write(tmp_path / "a.exr", {"Z": _DEPTH})
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    expected = (
        r"a\.exr: found an OpenEXR file; expected the package OpenEXR, to read it\. "
        r"Run: pip install 'tangent-train\[exr\]', or convert it to a float TIFF or \.npy file\."
    )
    for read in (read_exr, read_exr_size, read_depth_size, lambda path: read_depth_m(path, 1000)):
        with pytest.raises(DataError, match=expected):
            read(path)
