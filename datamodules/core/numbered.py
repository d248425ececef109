"""Decoder of releases whose label images hold a number for every class."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datamodules.core.panoramas import ImageFiles, PngReader, resize_nearest, units_to_steps
from tangent_train.errors import DataError
from tangent_train.io.pixel_files import read_image_size, read_pixels

_FORMATS = {"labels": (8, ("gray", "palette")), "depth": (16, ("gray",))}
_STRANGE = 255
"""Label of numbers that a data set does not have."""


def number_table(classes: Sequence[int], unknown: Iterable[int]) -> NDArray[np.uint8]:
    """Return the label of every number in a label image, ``(256,)``.

    Args:
        classes: Number of each class, in the order of the labels.
        unknown: Numbers of pixels without a class. Others are errors.

    >>> number_table([7, 9], [0, 255])[[0, 7, 8, 9, 255]].tolist()
    [0, 1, 255, 2, 0]
    """
    table = np.full(256, _STRANGE, np.uint8)
    table[list(unknown)] = 0
    table[list(classes)] = np.arange(1, len(classes) + 1)
    return table


@dataclass(frozen=True, eq=False)
class NumberedReader(PngReader):
    """Decoder of color images and of 8-bit label images, gray or with a palette.

    Attributes:
        table: Label of every number in a label image, see `number_table`.
        units_per_m: Units of 16-bit depth in a meter, 1000 for millimeters; 0 without depth.
    """

    table: NDArray[np.uint8]
    units_per_m: int = field(default=0, kw_only=True)

    formats = _FORMATS

    @property
    def settings(self) -> dict[str, str]:
        """See `ImageReader`: the label of every number."""
        return {"table": self.table.tobytes().hex()}

    def size(self, part: str, path: Path) -> tuple[int, int]:
        """See `ImageReader`; colors may be JPEG files."""
        return read_image_size(path) if part == "rgb" else super().size(part, path)

    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """See `ImageReader`; a palette is ignored."""
        numbers = read_pixels(files.parts["labels"], indices=True)
        labels = self.table[numbers]
        strange = np.unique(numbers[labels == _STRANGE])
        if strange.size:
            known = np.flatnonzero(self.table != _STRANGE)
            raise DataError(
                files.labels,
                found=f"numbers {', '.join(map(str, strange[:5]))}",
                expected=f"{', '.join(map(str, known))}",
                remedy="Use the label images of a release unconverted; your own data set may name "
                "further numbers in its number_table.",
            )
        return labels if shape is None else resize_nearest(labels, shape)

    def depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Read depth in steps of 1/512 m."""
        return units_to_steps(read_pixels(files.parts["depth"], indices=True), self.units_per_m)
