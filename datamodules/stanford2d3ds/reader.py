"""Decoder of the files of Stanford2D3DS."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datamodules.core.panoramas import ImageFiles, PngReader, Unknown, mask_black, resize_nearest
from datamodules.images.pixel_files import read_pixels, read_rgb
from datamodules.stanford2d3ds.label_table import LabelTable
from tangent_train.errors import DataError
from tangent_train.files import parse_json
from tangent_train.geometry import is_camera_matrix

_FORMATS = {"rgb": (8, ("RGB", "RGBA")), "labels": (8, ("RGB", "RGBA")), "depth": (16, ("grey",))}
_CENTERS_FROM_CORNERS = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
_MISSING_DEPTH = 65535


@dataclass(frozen=True)
class StanfordReader(PngReader):
    """Reader of panoramas and photos.

    Attributes:
        table: The classes of the instances.
        unknown: Pixels that count as unknown, see `mask_black`.
    """

    table: LabelTable
    unknown: Unknown = "labels"

    formats = _FORMATS

    @property
    def settings(self) -> dict[str, str]:
        """Unknown pixels and the class table in short."""
        classes = hashlib.sha256(self.table.class_ids.tobytes()).hexdigest()
        return {"unknown": self.unknown, "class table": classes}

    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Classes by the class table, 0 where black pixels are masked."""
        colors = read_rgb(files.labels)
        shape = shape or (colors.shape[0], colors.shape[1])
        labels = self.table.decode(resize_nearest(colors, shape), files.labels)
        if self.unknown == "labels":
            return labels
        return mask_black(labels, resize_nearest(self.rgb(files), shape), self.unknown)

    def depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Depth in steps of 1/512 m, as in the files."""
        return read_depth(files.parts["depth"])

    def camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """The camera matrix in the pose file."""
        return read_camera_matrix(files.parts["camera"])


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Depth in steps of 1/512 m, 0 where missing.

    Raises:
        DataError: The file is broken.
    """
    steps = read_pixels(path, indices=True)
    steps[steps == _MISSING_DEPTH] = 0
    return steps


def read_camera_matrix(path: Path) -> NDArray[np.float64]:
    """The camera matrix of a pose file.

    Args:
        path: ``camera_…_domain_pose.json``.

    Returns:
        ``(3, 3)`` K for integer pixel centres (the file counts from pixel corners).

    Raises:
        DataError: The file is missing or broken, or holds no such matrix.
    """
    expected = "a pose file with a camera_k_matrix of 3×3 numbers, without skew"
    try:
        matrix = np.array(parse_json(path.read_bytes())["camera_k_matrix"], np.float64)
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
        found = f"{type(error).__name__}: {error}"
        raise DataError(
            path, found=found, expected=expected, remedy="Copy or extract the file again."
        ) from error
    if not is_camera_matrix(matrix):
        raise DataError(path, found=matrix.tolist(), expected=expected)
    return _CENTERS_FROM_CORNERS @ matrix
