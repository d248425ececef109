"""Writes small user-defined data sets of photos: images, label images, classes, cameras."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from tests.datamodules.folder.folder_format import blocks, save, write_classes

# How a camera has stored the image that is displayed, by EXIF orientation.
_STORED = {
    1: lambda shown: shown,
    3: lambda shown: shown[::-1, ::-1],
    6: lambda shown: shown.swapaxes(0, 1)[::-1],
    8: lambda shown: shown.swapaxes(0, 1)[:, ::-1],
}


def displayed(seed: int, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Colors and label values of a photo as it is looked at."""
    values = blocks(seed, max(size))[: size[0], : size[1]]
    return np.stack([values, 255 - values // 2, np.full_like(values, 80 + seed)], axis=-1), values


def write_photo(
    root: Path,
    name: str,
    seed: int,
    size: tuple[int, int] = (48, 64),
    film_mm: int | None = 24,
    orientation: int = 1,
) -> None:
    """One photo.

    Args:
        root: Folder of the data set.
        name: File name with suffix.
        seed: Seed of the pixels.
        size: Rows and columns as displayed.
        film_mm: Focal length of film in its EXIF data.
        orientation: In its EXIF data.
    """
    rgb, values = displayed(seed, size)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    if film_mm is not None:
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: film_mm}
    stored = np.ascontiguousarray(_STORED[orientation](rgb))
    save(root / "images" / name, stored, exif=exif)
    save((root / "labels" / name).with_suffix(".png"), values)


def write_cameras(root: Path, content: Any) -> None:
    """Write `cameras.json`."""
    (root / "cameras.json").write_text(json.dumps(content))


def write_photos(root: Path, scenes: int = 5, each: int = 2) -> Path:
    """Scenes of photos, landscape and portrait, stored as displayed or turned."""
    write_classes(root)
    kinds = [((48, 64), 1, ".jpg"), ((64, 48), 6, ".png"), ((50, 66), 3, ".jpg")]
    for seed in range(scenes * each):
        size, orientation, suffix = kinds[seed % 3]
        name = f"scene_{seed // each}/view.{seed % each}{suffix}"
        write_photo(root, name, seed, size, orientation=orientation)
    return root
