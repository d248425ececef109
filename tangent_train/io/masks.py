"""Masks of panoramas: where their pixels do not count."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, SettingError, check_type
from tangent_train.io.gpano import PanoramaArea, read_area
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
        self._lowest_deg, self._path, self._of_all = -90.0, Path(setting), None
        self._counts, self.of_each = counts, False
        self._kept: tuple[PanoramaArea, NDArray[np.uint8]] | None = None
        if isinstance(mask, np.ndarray):
            self._of_all = mask != 0
        elif isinstance(mask, int | float):
            if not -90 < mask <= 0:
                expected = "a latitude above −90, at most 0 degrees; or a file or folder"
                raise SettingError(setting, found=mask, expected=expected)
            self._lowest_deg = mask
        elif mask is not None:
            check_type(setting, mask, (str, Path), "a latitude in degrees, a path or an array")
            self._path = Path(mask)
            self.of_each = self._path.is_dir()
            self._files = NamedFiles(self._path)
            self._of_all = None if self.of_each else counts(_checked(self._path))

    def check(self, name: str, area: PanoramaArea) -> None:
        """Check the header of the mask of one panorama.

        Args:
            name: See `read`.
            area: See `read`.

        Raises:
            DataError: It is missing, or has the shape of neither the panorama nor the sphere.
        """
        path = self._file(name)
        _area_of_mask(path, read_image_size(path), area)

    def read(self, name: str, area: PanoramaArea) -> NDArray[np.uint8]:
        """Return 255 where a panorama counts, and 0 elsewhere and where it shows nothing.

        Args:
            name: Path of the panorama in its folder, without suffix.
            area: The part of the sphere that it shows. A mask of its shape is of that part, unless
                it has the size of the whole panorama; others are of the whole sphere. Masks are
                sampled without interpolation.

        Returns:
            ``(H, W)`` of the whole sphere, not to be written to.

        Raises:
            DataError: There is no mask, or it cannot be used.
        """
        if self._kept is not None and self._kept[0] == area:
            return self._kept[1]
        path, stored = self._path, self._of_all
        if self.of_each:
            path = self._file(name)
            stored = self._counts(path)
        counts = area.place(np.full(area.image_shape, 255, np.uint8))
        rows = area.full_shape[0]
        counts[90 - (np.arange(rows) + 0.5) * 180 / rows < self._lowest_deg] = 0
        if stored is not None:
            part = _area_of_mask(path, stored.shape, area)
            counts[~resize(part.place(stored), area.full_shape, "nearest")] = 0
        if not self.of_each:
            self._kept = area, counts
        return counts

    def _file(self, name: str) -> Path:
        return _checked(self._files.path(f"{name}.png"))


def _checked(path: Path) -> Path:
    there = path.is_file()
    if not there or path.suffix.lower() in LOSSY_SUFFIXES:
        raise DataError(
            path,
            found="JPEG or WebP, which blur masks" if there else "no such file",
            expected="a mask as PNG, black where nothing counts; in a folder, one of the name of "
            "each panorama",
        )
    return path


def _area_of_mask(path: Path, size: tuple[int, int], area: PanoramaArea) -> PanoramaArea:
    """Return the area that a mask of rows and columns covers, see `Masks.read`."""
    height, width = area.image_shape
    if size != area.full_shape and math.isclose(
        size[1] * height, size[0] * width, rel_tol=_TOLERANCE
    ):
        return area
    return read_area(path, size, remedy=_REMEDY)
