"""Whole panoramas and photos as arrays, for user code."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Dataset

from datamodules.core.panoramas import ImageFiles, ImageReader, Labels, steps_to_meters
from datamodules.core.reading import SplitReader
from datamodules.core.transforms import RotatedPanoramas
from tangent_train.geometry import PanoramaPose


class LabeledImage(NamedTuple):
    """One panorama or photo.

    Attributes:
        name: Unique short name; ``/`` between groups.
        rgb: ``(H, W, 3)`` uint8.
        labels: ``(H, W)`` uint8 indices into the class names of the data set, 0 where unknown. If
            the labels are distances: uint16 steps of 1/512 m.
        distance_m: ``(H, W)`` float32 meters from the center of the camera, NaN where missing; None
            if depth is neither an input nor the labels of the data set.
        pose: Pose; None if unknown. In a photo's axes, x is the optical axis, y
            points to the right and z up in the image.
        camera_matrix: ``(3, 3)`` K of a photo for integer pixel centers; None for a panorama.
        valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.

    The arrays may be shared or read-only: do not write to them.
    """

    name: str
    rgb: NDArray[np.uint8]
    labels: Labels
    distance_m: NDArray[np.float32] | None
    pose: PanoramaPose | None
    camera_matrix: NDArray[np.float64] | None = None
    valid: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class LabeledImages(Dataset[LabeledImage]):
    """The images of a split, read one at a time, as training and evaluation read them.

    Attributes:
        source: Reader of the split.
        reader: Reader of the data set.
    """

    source: SplitReader[ImageFiles, Any]
    reader: ImageReader

    def __len__(self) -> int:
        return len(self.source)

    def __iter__(self) -> Iterator[LabeledImage]:
        return map(self.__getitem__, range(len(self)))

    def __getitem__(self, index: int) -> LabeledImage:
        index = range(len(self))[index]
        files, image = self.source.items[index], self.source.read(index)
        pose = self.reader.pose(files)
        for transform in self.source.transforms:
            if pose is not None and isinstance(transform, RotatedPanoramas):
                rotation = transform.rotation(index)
                pose = PanoramaPose(pose.world_from_panorama @ rotation.T, pose.location_m)
        depth = image.labels if image.labels.dtype == np.uint16 else image.depth
        distance_m = None if depth is None else steps_to_meters(depth)
        matrix = getattr(image, "camera_matrix", None)
        return LabeledImage(
            files.name, image.rgb, image.labels, distance_m, pose, matrix, image.valid
        )
