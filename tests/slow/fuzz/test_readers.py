"""Damaged files of strangers: pixels and fields come out, or a `DataError`."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tangent_train.checkpoints.loaded import load_network
from tangent_train.errors import DataError
from tangent_train.geometry import TangentGrid
from tangent_train.io.camera_files import CameraFile, read_cameras, write_cameras
from tangent_train.io.gpano import read_area
from tangent_train.io.pixel_files import read_pixels, write_pixels
from tests.datamodules.data_files import GPANO_TAGS, gpano_xmp
from tests.inference.trained import write_checkpoint

_COUNT = 30


def _image(path: Path) -> None:
    dtype: Any = np.float32 if path.suffix == ".npy" else np.uint16
    pixels = np.random.default_rng(0).integers(0, 255, (8, 16, 3)).astype(dtype)
    write_pixels(path, pixels if path.suffix != ".jpg" else pixels.astype(np.uint8))


def _panorama(path: Path) -> None:
    Image.new("RGB", (60, 40)).save(path, xmp=gpano_xmp(GPANO_TAGS))


def _cameras(path: Path) -> None:
    files = tuple(f"{face}.png" for face in range(20))
    write_cameras(path, CameraFile("a.png", (16, 32), TangentGrid(0, 3), tuple(range(20)), files))


def _read_image(path: Path) -> Any:
    return read_pixels(path, indices=True)


def _read_area(path: Path) -> Any:
    return read_area(path, (40, 60))


_READERS: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "a.png": (_image, _read_image),
    "a.tif": (_image, _read_image),
    "a.jpg": (_image, _read_image),
    "a.npy": (_image, _read_image),
    "a.webp": (_panorama, _read_area),
    "cameras.json": (_cameras, read_cameras),
    "net.ckpt": (write_checkpoint, load_network),
}


@pytest.mark.parametrize("name", _READERS)
def test_damaged_files_are_read_or_refused(name: str, tmp_path: Path) -> None:
    write, read = _READERS[name]
    path, rng, refused = tmp_path / name, Random(0), 0
    write(path)
    read(path)
    content = path.read_bytes()
    for number in range(_COUNT):
        damaged = bytearray(content)
        for _ in range(8):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        path.write_bytes(damaged[: rng.randrange(len(damaged))] if number % 3 == 0 else damaged)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                read(path)
            except DataError:
                refused += 1
    assert refused >= _COUNT // 5
