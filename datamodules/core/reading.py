"""Labelled images on disk: their files, decoding and checks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datamodules.core.panoramas import (
    Panorama,
    Photo,
    distance_from_z_depth,
    resize_area,
    resize_depth,
)
from datamodules.core.problems import Problems
from datamodules.images.pixel_files import read_rgb
from datamodules.images.png import check_panorama_size, check_png
from tangent_train.errors import DataError


class ImageFiles(NamedTuple):
    """The files of one panorama or photo.

    Attributes:
        name: Unique short name; ``/`` between groups.
        rgb: Colours.
        labels: Classes.
        depth: Depth, where it is an input.
        camera: File with the camera matrix, for photos with one file each.
    """

    name: str
    rgb: Path
    labels: Path
    depth: Path | None = None
    camera: Path | None = None

    @property
    def parts(self) -> dict[str, Path]:
        """All files by content."""
        return {part: path for part, path in self._asdict().items() if part != "name" and path}


class ImageReader(ABC):
    """Decoder of the files of a data set."""

    @property
    def settings(self) -> Mapping[str, str]:
        """Everything that affects labels and depth besides the files, such as a class table.

        Each choice has a prepared store of its own; by default there is nothing to choose.
        """
        return {}

    @abstractmethod
    def size(self, part: str, path: Path) -> tuple[int, int] | None:
        """Rows and columns from the header of a file, which must have the data set's format.

        Args:
            part: ``rgb``, ``labels`` or ``depth``.
            path: The file; it has to be whole.

        Returns:
            None for labels that have no pixels of their own, but are drawn at any size.

        Raises:
            DataError: It is not.
        """

    @abstractmethod
    def rgb(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Colours, ``(H, W, 3)``."""

    @abstractmethod
    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Classes, 0 where unknown.

        Args:
            files: Of the image.
            shape: ``(h, w)`` of the result, see `resize_nearest`; by default that of the file.

        Raises:
            DataError: The file is broken, or holds a value without a class.
        """

    def depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Depth ``(H, W)`` in steps of 1/512 m, 0 where missing; z-depth of photos."""
        raise NotImplementedError(files.name)

    def camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """``(3, 3)`` K of a photo for integer pixel centres, without skew."""
        raise NotImplementedError(files.name)


class PngReader(ImageReader):
    """Decoder of the PNG files of a release.

    Attributes:
        formats: Bits per channel and kinds of colours (`PngHeader.color`) by part.
    """

    formats: Mapping[str, tuple[int, Sequence[str]]]

    def size(self, part: str, path: Path) -> tuple[int, int]:
        """See `ImageReader`."""
        header = check_png(path, *self.formats[part])
        return header.height, header.width

    def rgb(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Colours; alpha is dropped."""
        return read_rgb(files.rgb)


@dataclass(frozen=True)
class _Reading:
    """Reads the images of a data set.

    Attributes:
        reader: Of the data set.
        num_classes: K + 1, the unknown class included.
        shape: Rows and columns of the result; None for those of the files.
    """

    reader: ImageReader
    num_classes: int
    shape: tuple[int, int] | None = None

    def labels(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Its labels alone, none beyond the classes."""
        labels = self.reader.labels(files, self.shape)
        if labels.max(initial=0) >= self.num_classes:
            raise DataError(
                files.labels,
                found=f"label {labels.max()}",
                expected=f"0 (unknown) to {self.num_classes - 1}",
                remedy="The data set's class_names and its reader's labels have to agree.",
            )
        return labels

    def parts(self, files: ImageFiles) -> list[Callable[[], object]]:
        """Functions that decode each of its files separately."""
        read = {"labels": replace(self, shape=None).labels}
        return [partial(read.get(part, getattr(self.reader, part)), files) for part in files.parts]


class PanoramaReading(_Reading):
    """Reads panoramas at one size."""

    def __call__(self, files: ImageFiles) -> Panorama:
        """One panorama."""
        shape: Any = self.shape
        depth = None if files.depth is None else resize_depth(self.reader.depth(files), shape)
        return Panorama(resize_area(self.reader.rgb(files), shape), depth, self.labels(files))


class PhotoReading(_Reading):
    """Reads photos; z-depth becomes distance from the centre of projection."""

    def __call__(self, files: ImageFiles) -> Photo:
        """One photo."""
        camera_matrix = self.reader.camera(files)
        depth = None
        if files.depth is not None:
            depth = distance_from_z_depth(self.reader.depth(files), camera_matrix)
        return Photo(self.reader.rgb(files), depth, self.labels(files), camera_matrix)


def check_headers(
    files: ImageFiles, reader: ImageReader, problems: Problems, erp_height: int | None = None
) -> tuple[int, int] | None:
    """Check that all files of an image are there, whole and of one size; nothing is decoded.

    Args:
        files: Of the image.
        reader: Of the data set.
        problems: Problems are added under the image's name.
        erp_height: Required rows of a panorama; None for photos.

    Returns:
        Rows and columns; None where the colours cannot be used.
    """
    size: tuple[int, int] | None = None
    for part in ("rgb", "labels", "depth"):
        path: Any = getattr(files, part)
        if path is None:
            continue
        with problems.noted(files.name, path):
            found = reader.size(part, path)
            if found is None:
                continue
            if part == "rgb":
                size = found
                if erp_height is not None:
                    check_panorama_size(path, found, erp_height)
            elif size not in (None, found):
                remedy = "Export or copy both at one size."
                if found[::-1] == size:
                    remedy = "Export it as the image is displayed, turned as its EXIF data say."
                raise DataError(
                    path,
                    found=f"{found[0]}×{found[1]} pixels",
                    expected=f"{size[0]}×{size[1]}, as {files.rgb}" if size else "",
                    remedy=remedy,
                )
    return size
