"""Files of Structured3D."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.datamodules.data_files import write_png

SCENES = (0, 1155, 2999, 3000, 3249, 3250, 3398, 3499)
HALF_ANGLES = 0.6, 0.37


def write_structured3d(
    root: Path, scenes: Sequence[int] = SCENES, height: int = 32, photos: bool = False
) -> Path:
    """Rooms whose labels are vertical stripes of all numbers, and whose depth is 25 mm per number.

    Furniture is numbered by rows, from 0; the first row is background.

    The labels have a palette in which the color of a number is another number, and the first of
    five rows of the panoramas is black.
    """
    for scene in scenes:
        room = root / f"scene_{scene:05d}" / "2D_rendering" / f"{scene + 100}"
        for configuration in ("full", "simple", "empty"):
            _write_image(room / "panorama" / configuration, height, 2 * height)
        objects = np.repeat(np.arange(height, dtype=np.uint16)[:, None], 2 * height, axis=1) - 1
        write_png(room / "panorama" / "full" / "instance.png", objects)
        for number in range(2 * photos):
            folder = room / "perspective" / "full" / str(number)
            _write_image(folder, height, height)
            angles = " ".join(map(str, HALF_ANGLES))
            (folder / "camera_pose.txt").write_text(f"1e3 2e3 1500 0 -1 0 0 0 1 {angles} 1\n")
    return root


def _write_image(folder: Path, height: int, width: int) -> None:
    numbers = np.broadcast_to(np.arange(width) % 41, (height, width)).astype(np.uint8)
    for k, lighting in enumerate(("rawlight", "warmlight", "coldlight")):
        rgb = np.full((height, width, 3), 100 + k, np.uint8)
        rgb[: height // 5] = 0
        write_png(folder / f"rgb_{lighting}.png", rgb)
    write_indices(folder / "semantic.png", numbers)
    write_png(folder / "depth.png", 25 * numbers.astype(np.uint16))


def write_indices(path: Path, numbers: NDArray[np.uint8]) -> None:
    """Write an image with a palette in which number k has the gray level 200 - k."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(numbers, "P")
    image.putpalette([200 - k if k <= 200 else 0 for k in range(256) for _ in range(3)])
    image.save(path)
