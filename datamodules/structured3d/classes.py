"""Classes of Structured3D, and the 8 of the benchmark S3D8."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datamodules.core.label_map import LabelMap
from datamodules.stanford2d3ds.files import EIGHT

CLASSES: tuple[str, ...] = (
    *("wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf"),
    *("picture", "counter", "blinds", "desk", "shelves", "curtain", "dresser", "pillow", "mirror"),
    *("floor mat", "clothes", "ceiling", "books", "refrigerator", "television", "paper", "towel"),
    *("shower curtain", "box", "whiteboard", "person", "night stand", "toilet", "sink", "lamp"),
    *("bathtub", "bag", "other structure", "other furniture", "other prop"),
)
"""The 40 classes of NYUv2 as labels 1 to 40, which are also the numbers in the files."""


LABEL_MAPS: dict[str, LabelMap] = {
    "40": LabelMap.of(CLASSES, [0]),
    "8": LabelMap.of(CLASSES, [0]).regrouped(LabelMap.grouped(EIGHT)),
    "published_s3d8": LabelMap.of(CLASSES, [0]).regrouped(LabelMap.grouped(EIGHT)),
}
"""Values of the setting `classes`; for the last one, see `published_s3d8`."""


def published_s3d8(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the 8 classes as the published readers of S3D8 compute them, to compare with scores.

    They replace the numbers of an image in place, in ascending order. The new number of a class
    (from 0) may be the old number of a later one: floor (2) becomes 3, and 3 is cabinet; wall (1)
    becomes 6, and 6 is sofa. So floor is unknown in images with cabinets, and wall is sofa in
    images with sofas.

    Args:
        labels: ``(H, W)`` numbers of the 40 classes, 0 where unknown.
    """
    new = LABEL_MAPS["8"].decode(np.arange(1 + len(CLASSES), dtype=np.uint8)).astype(np.int16) - 1
    numbers = labels.astype(np.int16)
    for number in np.unique(labels):
        numbers[numbers == number] = new[number]
    return (numbers + 1).astype(np.uint8)
