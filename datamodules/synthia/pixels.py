"""Labels and depth of SYNTHIA and OmniSYNTHIA."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from datamodules.core.panoramas import STEPS_PER_M
from datamodules.core.samples import RGBD_NORMALIZATION, Input, Normalization
from datamodules.images.png import read_png
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = [
    "CLASSES",
    "INVALID",
    "decode_labels",
    "default_normalization",
    "depth_steps",
    "read_first_channel",
    "read_view_labels",
]

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

_RGB = Normalization(mean=(0.4512, 0.4257, 0.3920), std=(0.2601, 0.2680, 0.2931))
_RGBD = Normalization(
    mean=(*_RGB.mean, RGBD_NORMALIZATION.mean[3]), std=(*_RGB.std, RGBD_NORMALIZATION.std[3])
)
_MOST = np.iinfo(np.uint16).max
_LAST_ID = 15
_NO_CLASS = 254


def default_normalization(inputs: Sequence[Input]) -> Normalization:
    """Normalization of SYNTHIA: of RGB as in the released code of the paper.

    Nobody published one of its depth; this is that of Stanford2D3DS, clipped alike.

    Args:
        inputs: See `SegmentationDataModule`.
    """
    return _RGBD if "depth" in inputs else _RGB


def read_first_channel(path: Path) -> NDArray[Any]:
    """Decode the red or only channel of an image as it is, ``(H, W)``.

    Raises:
        DataError: The file is broken.
    """
    image = read_png(path, cv2.IMREAD_UNCHANGED)
    # OpenCV's order is blue, green, red, and perhaps alpha.
    return image if image.ndim == 2 else cv2.extractChannel(image, 2)


def read_view_labels(path: Path) -> NDArray[np.uint8]:
    """Labels of a view as in the file, 0 to 15, ``(H, W)``.

    Raises:
        DataError: The file is broken or holds other labels.
    """
    ids = read_first_channel(path)
    if ids.max() > _LAST_ID:
        raise _strange_labels(path, ids[ids > _LAST_ID])
    return ids.astype(np.uint8)


def decode_labels(ids: NDArray[np.uint8], path: Path) -> NDArray[np.uint8]:
    """Classes of the labels in a file: 0 is unknown, others are as in `CLASSES`.

    Traffic lights, 15, become 13. `INVALID` and the reserved 13 and 14 are unknown: the published
    panoramas were averaged where views overlap, which may have made some.

    Args:
        ids: ``(H, W)``.
        path: Where they are from.

    Raises:
        DataError: There are other labels.
    """
    table = np.full(256, _NO_CLASS, np.uint8)
    table[: _LAST_ID + 1] = [*range(13), 0, 0, 13]
    table[INVALID] = 0
    labels = cv2.LUT(ids, table)
    if labels.max() == _NO_CLASS:
        raise _strange_labels(path, ids[labels == _NO_CLASS])
    return labels


def depth_steps(centimeters: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Depth in steps of 1/512 m, rounded, at most 65535 (128 m), of depth in cm.

    >>> depth_steps(np.array([0, 1, 100, 65535], np.uint16)).tolist()
    [0, 5, 512, 65535]
    """
    steps = np.minimum(centimeters * (STEPS_PER_M / 100) + 0.5, _MOST)
    return steps.astype(np.uint16)


def _strange_labels(path: Path, ids: NDArray[Any]) -> DataError:
    values = ", ".join(map(str, np.unique(ids)[:5]))
    return DataError(
        path,
        found=f"labels {values}",
        expected=f"0 to {_LAST_ID}, and {INVALID} in panoramas",
        remedy="Use the files as released (GT/LABELS, not GT/COLOR).",
    )
