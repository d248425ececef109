"""Writes small user-defined data sets: images, label images, depth, `classes.json`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.datamodules.data_files import write_png

NAMES = ("wall", "floor", "window")
VALUES = {"wall": 1, "floor": [2, 3], "window": 255}
"""Value 0 and 4 and others are unknown."""
_STORED = np.array([0, 1, 2, 3, 255, 4])
CLASS_OF_STORED = {0: 0, 1: 1, 2: 2, 3: 2, 255: 3, 4: 0}


def blocks(seed: int, height: int) -> NDArray[np.uint8]:
    """Label values in squares of a few pixels, ``(height, 2 height)``."""
    rng = np.random.default_rng(seed)
    side = max(1, height // 8)
    small = _STORED[rng.integers(0, len(_STORED), (-(-height // side), -(-2 * height // side)))]
    large = np.kron(small, np.ones((side, side), np.int64))
    return large[:height, : 2 * height].astype(np.uint8)


def write_panorama(
    root: Path, name: str, seed: int, height: int = 32, suffix: str = ".png", *, depth: bool = False
) -> None:
    """One panorama whose colors tell its label values."""
    values = blocks(seed, height)
    rgb = np.stack([values, 255 - values // 2, np.full_like(values, 80 + seed % 100)], axis=-1)
    save(root / "images" / f"{name}{suffix}", rgb)
    save(root / "labels" / f"{name}.png", values)
    if depth:
        write_png(root / "depth" / f"{name}.png", 500 + 40 * values.astype(np.uint16))


def save(path: Path, image: NDArray[np.uint8], **settings: Any) -> None:
    """Write an image in the format of its suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, **settings)


def write_classes(root: Path, content: Any = VALUES) -> None:
    """Write `classes.json`."""
    root.mkdir(parents=True, exist_ok=True)
    (root / "classes.json").write_text(json.dumps(content))


def write_data_set(
    root: Path, scenes: int = 6, each: int = 2, height: int = 32, *, depth: bool = False
) -> Path:
    """Scenes with panoramas in several formats."""
    write_classes(root)
    suffixes = (".png", ".tif", ".webp", ".jpg")
    for scene in range(scenes):
        for number in range(each):
            seed = scene * each + number
            name = f"scene_{scene}/view.{number}"
            write_panorama(root, name, seed, height, suffixes[seed % 4], depth=depth)
    return root


def write_strips(root: Path, size: tuple[int, int], count: int = 4, *, depth: bool = False) -> Path:
    """Partial panoramas of rows and columns, whose red channel holds the label values."""
    write_classes(root)
    for number in range(count):
        values = blocks(number, max(size))[: size[0], : size[1]]
        green = np.random.default_rng(number).integers(1, 256, size, np.uint8)
        save(root / "images" / f"{number}.png", np.stack([values, green, green], axis=-1))
        save(root / "labels" / f"{number}.png", values)
        if depth:
            write_png(root / "depth" / f"{number}.png", values.astype(np.uint16) + 300)
    return root
