"""The files are written by OpenEXR's own package."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from tangent_train.errors import DataError
from tangent_train.io.pixel_files import read_image_size, read_pixels

_DEPTH = np.fromfunction(lambda row, column: (row // 8 + column % 12) / 4 + 0.5, (40, 96)).astype(
    np.float32
)


def _write(path: Path, channels: dict[str, Any], **header: Any) -> Path:
    plain = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(plain | header, channels).write(str(path))
    return path


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.uint32])
@pytest.mark.parametrize("compression", [OpenEXR.NO_COMPRESSION, OpenEXR.PIZ_COMPRESSION])
def test_pixels_are_as_written(tmp_path: Path, compression: Any, dtype: type[Any]) -> None:
    depth = _DEPTH.astype(dtype)
    window = (np.array([5, -7], np.int32), np.array([100, 32], np.int32))
    path = _write(tmp_path / "ä (1).exr", {"Z": depth}, compression=compression, dataWindow=window)
    read = read_pixels(path, indices=True)
    assert read.dtype == dtype
    np.testing.assert_array_equal(read, depth)
    assert read_image_size(path) == (40, 96)


@pytest.mark.parametrize(
    ("others", "name"),
    [
        ([], "distance"),
        (["R", "G", "B", "A"], "Z"),
        (["L.R", "L.G", "L.B", "M.Normal.X"], "L.Depth.Z"),
        (["R", "G", "B", "V"], "Y"),
        (["G", "B"], "R"),
        (["a.Y", "b.Y"], "V"),
    ],
)
def test_the_channel_of_depth_is_found(tmp_path: Path, others: list[str], name: str) -> None:
    channels: dict[str, Any] = {other: np.zeros((40, 96), np.float16) for other in others}
    path = _write(tmp_path / "a.exr", channels | {name: _DEPTH})
    np.testing.assert_array_equal(read_pixels(path, indices=True), _DEPTH)


def test_several_parts_and_deep_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    parts = [OpenEXR.Part({"name": name}, {"Z": _DEPTH}) for name in ("left", "right")]
    OpenEXR.File(parts).write(str(path))
    with pytest.raises(DataError, match=r"a\.exr: found .*2 parts"):
        read_pixels(path, indices=True)
    deep = np.empty((4, 3), object)
    for place in np.ndindex(4, 3):
        deep[place] = np.ones(1 + place[0], np.float32)
    _write(path, {"Z": deep}, type=OpenEXR.deepscanline, compression=OpenEXR.ZIPS_COMPRESSION)
    with pytest.raises(DataError, match=r"a\.exr: found"):
        read_pixels(path, indices=True)
