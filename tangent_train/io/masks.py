"""Masks of panoramas: where their pixels do not count."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.io.gpano import PanoramaArea, whole_area
from tangent_train.io.image_files import NamedFiles
from tangent_train.io.pixel_files import LOSSY_SUFFIXES, read_image_size, read_pixels
from tangent_train.rendering.resampling import resize

Mask = float | Path | None
"""Pixels of panoramas that do not count: below a latitude, −90 to 0 degrees; black in a file, for
all panoramas, or in the PNG files of a folder, which has one for each; or none."""

Counts = Callable[[Path], NDArray[np.bool_]]
"""Reads a mask: where it counts, ``(H, W)``."""

_TOLERANCE = 0.02  # of the ratio of width and height
_REMEDY = "Make a mask of the size of its image, or of the whole panorama."


def _not_black(path: Path) -> NDArray[np.bool_]:
    pixels = read_pixels(path, indices=False)
    return np.asarray((pixels != 0).reshape(*pixels.shape[:2], -1).any(axis=-1))


def _area_of_mask(path: Path, size: tuple[int, int], area: PanoramaArea) -> PanoramaArea:
    """Return the area that a mask of rows and columns covers, see `Masks.read`."""
    height, width = area.image_shape
    has_shape = math.isclose(size[1] * height, size[0] * width, rel_tol=_TOLERANCE)
    if size == area.image_shape or (has_shape and abs(width - 2 * height) > 1):
        return area
    if has_shape and not area.is_whole and size != area.full_shape:
        raise DataError(
            path,
            found=width_height(size),
            expected=f"{width_height(area.image_shape)} for the part that the panorama shows, or "
            f"{width_height(area.full_shape)} for the whole sphere",
            remedy="Resize the mask: both have the same shape.",
        )
    return whole_area(path, size, _REMEDY)


class Masks:
    """Pixels of panoramas that count, in the frame in which they are stored.

    Args:
        mask: See `Mask`; text is a path; of an array ``(H, W)`` 0 and False do not count.
        setting: Name of the setting, for messages.
        counts: Reads a file.

    Attributes:
        of_each: True if every panorama has its own mask.

    Raises:
        DataError: There is no such file, or it cannot be read.
        SettingError: There is no such latitude.
    """

    def __init__(
        self,
        mask: Mask | str | NDArray[Any],
        setting: str = "mask",
        counts: Counts = _not_black,
    ) -> None:
        self._lowest_deg, self._path, self._of_all = -90.0, Path(), None
        self._counts, self.of_each = counts, False
        self._files: NamedFiles | None = None
        self._kept: tuple[PanoramaArea, NDArray[np.uint8]] | None = None
        if isinstance(mask, str | Path):
            self._path = Path(mask)
            self.of_each = self._path.is_dir()
            self._files = NamedFiles(self._path) if self.of_each else None
            self._of_all = None if self.of_each else counts(self._checked(self._path))
        elif isinstance(mask, np.ndarray) and mask.ndim == 2:
            self._path, self._of_all = Path(setting), mask != 0
        elif isinstance(mask, int | float) and not isinstance(mask, bool) and -90 < mask <= 0:
            self._lowest_deg = float(mask)
        elif mask is not None:
            expected = "a latitude above −90, at most 0 degrees; or a file or folder"
            raise SettingError(setting, found=mask, expected=expected)

    def check(self, name: str, area: PanoramaArea) -> None:
        """Check the header of the mask of one panorama.

        Args:
            name: See `read`.
            area: See `read`.

        Raises:
            DataError: It is missing, or has the shape of neither the panorama nor the sphere.
        """
        path = self._checked(self._file(name))
        _area_of_mask(path, read_image_size(path), area)

    def read(self, name: str, area: PanoramaArea) -> NDArray[np.uint8]:
        """Return 255 where a panorama counts, and 0 elsewhere and where it shows nothing.

        Args:
            name: Path of the panorama in its folder, without suffix.
            area: The part of the sphere that it shows. A mask of its size or shape is of that
                part, others are of the whole sphere; they are sampled without interpolation.

        Returns:
            ``(H, W)`` of the whole sphere, not to be written to.

        Raises:
            DataError: There is no mask, or it cannot be used.
        """
        kept = self._kept
        if kept is not None and kept[0] == area:
            return kept[1]
        path, stored = self._path, self._of_all
        if self.of_each:
            path = self._file(name)
            stored = self._counts(self._checked(path))
        counts = area.place(np.full(area.image_shape, 255, np.uint8))
        rows = area.full_shape[0]
        counts[90 - (np.arange(rows) + 0.5) * 180 / rows < self._lowest_deg] = 0
        if stored is not None:
            place = _area_of_mask(path, stored.shape, area)
            counts[~resize(place.place(stored), area.full_shape, "nearest")] = 0
        if not self.of_each:
            self._kept = area, counts
        return counts

    def _file(self, name: str) -> Path:
        return self._path if self._files is None else self._files.path(f"{name}.png")

    def _checked(self, path: Path) -> Path:
        there = path.is_file()
        if not there or path.suffix.lower() in LOSSY_SUFFIXES:
            raise DataError(
                path,
                found="JPEG or WebP, which blur masks" if there else "no such file",
                expected="a mask as PNG, black where nothing counts; in a folder, one of the name "
                "of each panorama",
            )
        return path
