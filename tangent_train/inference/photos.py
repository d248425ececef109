"""Labels of photos."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from datamodules.core.panoramas import resize_area, resize_depth
from datamodules.core.photos import distance_from_z_depth
from tangent_train.errors import SettingError
from tangent_train.geometry import nearest_level
from tangent_train.inference.predictor import Done, InputImage, Level, Prediction, Runner
from tangent_train.inference.seen import photo_representation
from tangent_train.rendering.mosaic import ScoreMosaic
from tangent_train.rendering.representations.perspective import PhotoCrops

if TYPE_CHECKING:
    from tangent_train.checkpoints.trained import TrainedNetwork
    from tangent_train.rendering import Blend, PerspectiveRepresentation

__all__ = ["PhotoPredictor"]

_OVERLAP = 0.25
"""Least overlap of neighbouring crops that are feathered, as a share of their side."""

_FINER = 2
"""Pixels of a photo per pixel of a crop that are kept of photos smaller than a crop."""

_Boxes = Callable[[NDArray[np.float64]], NDArray[np.float64]]


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
        if "elevation" in trained.inputs:
            raise SettingError(
                "projection",
                found="perspective",
                expected="equirectangular: the network is shown how far each pixel looks up, "
                "which nobody knows of photos",
            )
        self._runner, self._blend = runner, blend
        self._level = trained.level if level is None else level
        self._seen = lru_cache(maxsize=4)(
            partial(photo_representation, trained, base_level=base_level)
        )
        if self._level != "image":
            self._seen(self._level)

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
        representation = self._seen(level)
        whole, matrix, to_photo = _fitted(image, camera_matrix, representation)
        sampler = representation.of_camera(matrix, whole.rgb.shape[:2])
        overlap = _OVERLAP if self._blend == "feather" else 0.0
        crops = sampler.cover(overlap)
        in_photo = PhotoCrops(to_photo(crops.boxes), crops.size)
        mosaic = ScoreMosaic(
            (height, width), self._runner.num_classes, self._blend, averaged=averaged
        )
        count = len(crops.boxes)
        for part in self._runner.parts(count, crops.size):
            scores = self._runner.scores(whole, PhotoCrops(crops.boxes[part], crops.size))
            mosaic.add_crops(scores, in_photo, part)
            done(len(part) / count)
        return Prediction(mosaic, level, count)


def _fitted(
    image: InputImage, camera_matrix: NDArray[np.float64], wanted: PerspectiveRepresentation
) -> tuple[InputImage, NDArray[np.float64], _Boxes]:
    """The photo; where it is smaller than a crop, mirrored at its borders.

    Of those only as many pixels are kept as the crops need: mirrored, a photo of a telescope would
    fill the memory.

    Returns:
        The image with distance as depth, its K, and what brings boxes in it back to the photo.
    """
    depth = image.depth
    if depth is not None:
        depth = distance_from_z_depth(depth, camera_matrix)
    size, rgb = image.rgb.shape[:2], image.rgb
    pixel = 2 * math.tan(math.radians(wanted.fov_deg) / 2) / wanted.image_size[1]
    per_pixel = pixel * np.diag(camera_matrix)[[1, 0]]  # pixels of the photo, down and across
    least = wanted.image_size * per_pixel
    if np.all(least <= size):
        return InputImage(rgb, depth), camera_matrix, lambda boxes: boxes
    kept = np.minimum(1, _FINER / per_pixel)
    rows, columns = (max(1, round(n * share)) for n, share in zip(size, kept, strict=True))
    scale = np.array([columns / size[1], rows / size[0]])
    least = np.ceil(least * scale[::-1] + 1e-6)
    top, left = (math.ceil(max(0, a - b) / 2) for a, b in zip(least, (rows, columns), strict=True))
    borders = (top, top, left, left, cv2.BORDER_REFLECT_101)
    rgb = cv2.copyMakeBorder(resize_area(rgb, (rows, columns)), *borders)
    if depth is not None:
        depth = cv2.copyMakeBorder(resize_depth(depth, (rows, columns)), *borders)
    matrix = camera_matrix.copy()
    matrix[:2, 2] += 0.5
    matrix[:2] *= scale[:, None]
    matrix[:2, 2] += (left - 0.5, top - 0.5)
    offset, factor = np.tile((left, top), 2), np.tile(scale, 2)
    return InputImage(rgb, depth), matrix, lambda boxes: (boxes - offset) / factor
