"""Labels of photos."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from datamodules.photos import distance_from_z_depth
from tangent_train.geometry import nearest_level
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.perspective import PhotoCrops
from tangent_train.tasks.prediction.predictor import Done, InputImage, Level, Prediction, Runner
from tangent_train.tasks.prediction.seen import photo_representation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.rendering import Blend, PerspectiveRepresentation
    from tangent_train.tasks.networks import TrainedNetwork

__all__ = ["PhotoPredictor"]

_OVERLAP = 0.25
"""Least overlap of neighbouring crops that are feathered, as a share of their side."""


class PhotoPredictor:
    """Labels photos, in crops that have the angular resolution the network knows.

    Args:
        trained: The network.
        runner: Shows it images.
        level: Level s the network sees.
        base_level: Crops of the size of tangent images of another base level b.
        blend: ``feather``: crops overlap by a quarter and are averaged.

    Raises:
        SettingError: A setting that cannot work.
    """

    def __init__(
        self,
        trained: TrainedNetwork,
        runner: Runner,
        level: Level = None,
        base_level: int | None = None,
        blend: Blend = "feather",
    ) -> None:
        self._trained, self._runner = trained, runner
        self._base_level, self._blend = base_level, blend
        self._level = trained.level if level is None else level
        if self._level != "image":
            photo_representation(trained, self._level, base_level)

    def predict(
        self,
        image: InputImage,
        camera_matrix: NDArray[np.float64],
        done: Done,
        *,
        averaged: bool = False,
    ) -> Prediction:
        """The scores of one photo.

        Args:
            image: It; `depth` is along the optical axis, as depth cameras give it.
            camera_matrix: ``(3, 3)`` K, integer pixel centres.
            done: Told of the progress.
            averaged: Whether probabilities will be asked for.
        """
        height, width = image.rgb.shape[:2]
        level = self._level
        if level == "image":  # of panoramas with the photo's angular resolution
            level = nearest_level(round(math.pi * camera_matrix[1, 1]))
        representation = photo_representation(self._trained, level, self._base_level)
        whole, margin, matrix = _widened(image, camera_matrix, representation)
        sampler = representation.of_camera(matrix, whole.rgb.shape[:2])
        overlap = _OVERLAP if self._blend == "feather" else 0.0
        crops = sampler.cover(overlap)
        left, top = margin
        in_photo = PhotoCrops(crops.boxes - [left, top, left, top], crops.size)
        mosaic = ScoreMosaic(
            (height, width), self._runner.num_classes, self._blend, averaged=averaged
        )
        count = len(crops.boxes)
        for part in self._runner.parts(count, crops.size):
            scores = self._runner.scores(whole, PhotoCrops(crops.boxes[part], crops.size))
            mosaic.add_crops(scores, in_photo, part)
            done(len(part) / count)
        return Prediction(mosaic, level, count)


def _widened(
    image: InputImage, camera_matrix: NDArray[np.float64], wanted: PerspectiveRepresentation
) -> tuple[InputImage, tuple[int, int], NDArray[np.float64]]:
    """The photo, mirrored at its borders where it is smaller than one crop.

    Returns:
        The image with distance as depth, columns and rows added to the left and on top, and its K.
    """
    size = image.rgb.shape[:2]
    rows, columns = wanted.image_size
    pixel = 2 * math.tan(math.radians(wanted.fov_deg) / 2) / columns
    least = (rows * pixel * camera_matrix[1, 1], columns * pixel * camera_matrix[0, 0])
    depth = image.depth
    if depth is not None:
        depth = distance_from_z_depth(depth, camera_matrix)
    missing = [max(0, math.ceil(a - b + 1e-6)) for a, b in zip(least, size, strict=True)]
    if not any(missing):
        return InputImage(image.rgb, depth), (0, 0), camera_matrix
    # Twice the half, so that the principal point stays as near to the middle as it was.
    top, left = ((n + 1) // 2 for n in missing)
    borders = (top, top, left, left, cv2.BORDER_REFLECT_101)
    matrix = camera_matrix.copy()
    matrix[:2, 2] += left, top
    rgb = cv2.copyMakeBorder(image.rgb, *borders)
    depth = None if depth is None else cv2.copyMakeBorder(depth, *borders)
    return InputImage(rgb, depth), (left, top), matrix
