"""Cityscapes, DensePASS and SynPASS in their real formats, fabricated."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.datamodules.data_files import write_png

CAMERA = {"fx": 2262.52, "fy": 2265.3017905988554, "u0": 1096.98, "v0": 513.137}
"""Camera of real photos of 1024×2048."""

CITIES = {"train": ("aachen", "bremen", "ulm"), "val": ("lindau",), "test": ("berlin",)}
TRAIN_IDS = [*range(19), 255]
IDS = [*range(34), 255]
SYNPASS_NUMBERS = [*range(23), 255]


def numbers(values: Sequence[int], size: tuple[int, int], first: int = 0) -> NDArray[np.uint8]:
    """Blocks of all values, in another order for every `first`."""
    rows, columns = np.indices(size)
    return np.array(values, np.uint8)[(rows // 2 + columns // 3 + first) % len(values)]


def colors(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """BGR by label."""
    return np.stack([labels * 7, 255 - labels, labels // 2], axis=-1)


def write_cityscapes(root: Path, rows: int = 64, each: int = 1) -> Path:
    """Write photos of twice as many columns as rows; of test, dummy labels."""
    scale = rows / 1024
    for split, cities in CITIES.items():
        for city in cities:
            for number in range(each):
                stem = f"{city}_000000_{number:06d}"
                values = [0, 1, 2, 3] if split == "test" else IDS
                ids = numbers(values, (rows, 2 * rows), number)
                images = root / "leftImg8bit" / split / city / f"{stem}_leftImg8bit.png"
                write_png(images, colors(ids))
                write_png(root / "gtFine" / split / city / f"{stem}_gtFine_labelIds.png", ids)
                write_png(root / "gtFine" / split / city / f"{stem}_gtFine_instanceIds.png", ids)
                camera = root / "camera" / split / city / f"{stem}_camera.json"
                camera.parent.mkdir(parents=True, exist_ok=True)
                intrinsic = {name: scale * value for name, value in CAMERA.items()}
                content = {"extrinsic": {"pitch": 0.038, "z": 1.22}, "intrinsic": intrinsic}
                camera.write_text(json.dumps(content))
    return root


def write_densepass(root: Path, spelling: str = "_", names: Sequence[int] = (1, 10, 500)) -> Path:
    """Write labeled panoramas of 400×2048, and unlabeled ones of three cities."""
    for name in names:
        ids = numbers(TRAIN_IDS, (400, 2048), name)
        write_png(root / f"leftImg8bit/val/cs/{name}{spelling}.png", colors(ids))
        write_png(root / f"gtFine/val/cs/{name}_labelTrainIds.png", ids)
    for city in ("Oslo", "Rome", "Zurich"):
        write_png(root / f"leftImg8bit/train/{city}/1.png", colors(ids))
    return root


SYNPASS: Mapping[tuple[str, str], Sequence[str]] = {
    ("cloud", "train"): ("MAP_1_point1", "MAP_1_point2", "MAP_2_point3"),
    ("fog", "val"): ("MAP_6_point10",),
    ("sun", "val"): ("MAP_6_point11",),
    ("sun", "test"): ("MAP_8_point1",),
}
"""Points by weather and split."""


def write_synpass(root: Path, rows: int = 32, each: int = 2) -> Path:
    """Write panoramas as JPEG, label images with and without a palette, and the two lists."""
    for (weather, split), points in SYNPASS.items():
        for point in points:
            for number in range(each):
                first = number + 5 * (weather == "fog")
                ids = numbers(SYNPASS_NUMBERS, (rows, 2 * rows), first)
                rgb = root / "img" / weather / split / point / f"{number:06d}.jpg"
                rgb.parent.mkdir(parents=True, exist_ok=True)
                assert cv2.imwrite(str(rgb), colors(ids))
                labels = root / "semantic" / weather / split / point / f"{number:06d}_trainID.png"
                write_labels(labels, ids, palette=number % 2 == 1)
    (root / "all_map_day_val.txt").write_text("MAP_6_point10\n")
    (root / "all_map_night_val.txt").write_text("MAP_6_point11\nMAP_7_point99\n")
    return root


def write_labels(path: Path, stored: NDArray[np.uint8], *, palette: bool) -> None:
    """Write a label image, gray or with a palette whose colors are not its numbers."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image: Any = Image.fromarray(stored)
    if palette:
        image.putpalette([(7 * k + c) % 256 for k in range(256) for c in range(3)])
    image.save(path)
