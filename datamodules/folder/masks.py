"""Masks of panoramas: where their pixels do not count."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from datamodules.folder.classes import read_classes
from datamodules.folder.reader import read_codes
from datamodules.images.pixel_files import LOSSY_SUFFIXES, read_image_size, read_pixels
from datamodules.images.tangent_folders import panorama_area
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["Masks"]


class Masks:
    """What of panoramas to ignore: black pixels of masks, or pixels of some classes.

    Args:
        path: A mask for all panoramas, or a folder with a PNG file for each; with `classes` a
            folder with ``labels/`` and ``classes.json``, as of ``data=folder``. None: everything
            that an image shows counts.
        classes: Names of the classes to ignore.

    Raises:
        DataError: ``classes.json`` is missing or cannot be used.
        SettingError: It does not name one of the classes, or classes are given without a folder.
    """

    def __init__(self, path: Path | None, classes: tuple[str, ...] | None) -> None:
        self._path, self._classes = path, None
        if classes:
            if path is None:
                expected = "mask=<a folder with labels/ and classes.json> too"
                raise SettingError("mask_classes", found=", ".join(classes), expected=expected)
            self._classes = read_classes(path / "classes.json")
            self._path = path / "labels"
            names = self._classes.names
            if set(classes) - set(names):
                found = ", ".join(sorted(set(classes) - set(names)))
                raise SettingError("mask_classes", found=found, expected=f"of {', '.join(names)}")
            self._ignored = [names.index(name) + 1 for name in classes]

    def read(self, name: str, panorama: Path) -> NDArray[np.uint8]:
        """Where a panorama counts: 255, elsewhere 0.

        Args:
            name: Its path in the folder of panoramas, without ending.
            panorama: Its file.

        Returns:
            ``(H, W)``, the whole sphere, of any size. A mask of the size of a partial panorama is
            of that part, and what is beyond does not count.

        Raises:
            DataError: There is no mask, or it cannot be used.
        """
        size = read_image_size(panorama)
        area = panorama_area(panorama, size)
        if self._path is None:
            return area.place(np.full(size, 255, np.uint8))
        path = self._path if self._path.is_file() else self._path / f"{name}.png"
        if not path.is_file() or path.suffix.lower() in LOSSY_SUFFIXES:
            raise DataError(
                path,
                found="no such file" if not path.is_file() else "JPEG or WebP, which blur masks",
                expected="the mask of the panorama: a PNG file of its name, black is ignored",
            )
        counts = self._decode(path)
        area = area if counts.shape == size else panorama_area(path, counts.shape)
        return area.place(counts)

    def _decode(self, path: Path) -> NDArray[np.uint8]:
        if self._classes is not None:
            labels = self._classes.decode(read_codes(path, in_colors=self._classes.in_colors), path)
            counts = ~np.isin(labels, self._ignored)
        else:
            pixels = read_pixels(path, indices=False)
            counts = (pixels != 0).reshape(*pixels.shape[:2], -1).any(axis=-1)
        return np.where(counts, np.uint8(255), np.uint8(0))
