from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from datamodules.images.png import (
    PngHeader,
    check_panorama_size,
    check_png,
    read_color_png,
    read_depth_png,
    read_png_header,
)
from tangent_train.errors import DataError, SettingError
from tests.datamodules.data_files import write_png

READERS = [read_png_header, read_color_png, read_depth_png]


def _written(folder: Path, image: np.ndarray[Any, Any]) -> Path:
    write_png(folder / "image.png", image)
    return folder / "image.png"


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
    path = _written(tmp_path, np.zeros(shape, dtype))
    assert check_png(path, bits, (color,)) == PngHeader(4, 8, bits, color)
    with pytest.raises(DataError, match=rf"found {bits}-bit {color}; expected 8-bit palette"):
        check_png(path, 8, ("palette",))


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("missing", [slice(-20, None), slice(-1, None), slice(1000, 3000)])
def test_truncated_files_are_named(tmp_path: Path, missing: slice, read: Any) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (64, 128, 3), np.uint8)
    path = _written(tmp_path, noise)
    content = bytearray(path.read_bytes())
    del content[missing]
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"image\.png: found .* truncated"):
        read(path)


def test_size_of_panoramas(tmp_path: Path) -> None:
    check_panorama_size(tmp_path, (64, 128), 64)
    with pytest.raises(DataError, match="found 64×127 pixels; expected twice as wide as high"):
        check_panorama_size(tmp_path, (64, 127), 64)
    with pytest.raises(SettingError, match="at most the 64 rows"):
        check_panorama_size(tmp_path, (64, 128), 65)
