"""Decoder of the files of SYNTHIA and OmniSYNTHIA: labels, depth, cameras."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datamodules.core.inputs import RGBD_NORMALIZATION, Normalization
from datamodules.core.panoramas import ImageFiles, PngReader, meters_to_steps, resize_nearest
from datamodules.images.pixel_files import read_pixels
from datamodules.synthia.files import read_camera
from tangent_train.errors import DataError

CLASSES: tuple[str, ...] = (
    "sky",
    "building",
    "road",
    "sidewalk",
    "fence",
    "vegetation",
    "pole",
    "car",
    "traffic sign",
    "pedestrian",
    "bicycle",
    "lane marking",
    "traffic light",
)
"""The classes as labels 1 to 13. In the files traffic lights are 15; 13 and 14 are reserved."""

INVALID = 255
"""Label of a panorama where no view looks."""

NORMALIZATIONS = (
    Normalization(mean=(0.4512, 0.4257, 0.3920), std=(0.2601, 0.2680, 0.2931)),
    Normalization(
        mean=(0.4512, 0.4257, 0.3920, RGBD_NORMALIZATION.mean[3]),
        std=(0.2601, 0.2680, 0.2931, RGBD_NORMALIZATION.std[3]),
    ),
)
"""RGB as in the released code of the paper. None is published for SYNTHIA's depth; this is
that of Stanford2D3DS, clipped alike."""

Formats = dict[str, tuple[int, tuple[str, ...]]]
"""Bits and colour types by part."""

VIEW_FORMATS: Formats = {
    "rgb": (8, ("RGB", "RGBA")),
    "labels": (16, ("RGB", "RGBA")),
    "depth": (16, ("grey", "RGB", "RGBA")),
}
"""Pixel formats of a view."""

PANORAMA_FORMATS: Formats = {
    "rgb": (8, ("RGB", "RGBA")),
    "labels": (8, ("grey",)),
    "depth": (16, ("grey",)),
}
"""Pixel formats of a panorama."""

_LAST_ID = 15
_LABELS = np.zeros(256, np.uint8)
# Traffic lights, 15, become 13. The reserved 13 and 14 are unknown: the published panoramas were
# averaged where views overlap, which may have made some.
_LABELS[: _LAST_ID + 1] = [*range(13), 0, 0, 13]


@dataclass(frozen=True)
class SynthiaReader(PngReader):
    """Views and panoramas alike.

    Attributes:
        formats: `VIEW_FORMATS` or `PANORAMA_FORMATS`.
    """

    formats: Formats

    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Classes as in `CLASSES`, 0 where unknown."""
        ids = read_ids(files.labels)
        return cv2.LUT(resize_nearest(ids, shape or (ids.shape[0], ids.shape[1])), _LABELS)

    def depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Depth in steps of 1/512 m."""
        centimeters = read_first_channel(files.parts["depth"])
        return meters_to_steps((centimeters / 100).astype(np.float32))

    def camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """The camera matrix of the sequence that the view is from."""
        return read_camera(files.rgb.parents[3], self.size("rgb", files.rgb))


def read_first_channel(path: Path) -> NDArray[Any]:
    """Decode the red or only channel of an image as it is, ``(H, W)``.

    Raises:
        DataError: The file is broken.
    """
    image = read_pixels(path, indices=True)
    return image if image.ndim == 2 else image[..., 0]


def read_ids(path: Path) -> NDArray[np.uint8]:
    """Labels as in the file, ``(H, W)``: 0 to 15, or `INVALID`.

    Raises:
        DataError: The file is broken or holds other labels.
    """
    ids = read_first_channel(path)
    strange = ids[(ids > _LAST_ID) & (ids != INVALID)]
    if strange.size:
        raise DataError(
            path,
            found=f"labels {', '.join(map(str, np.unique(strange)[:5]))}",
            expected=f"0 to {_LAST_ID}, and {INVALID} in panoramas",
            remedy="Use the files as released (GT/LABELS, not GT/COLOR).",
        )
    return ids.astype(np.uint8)
