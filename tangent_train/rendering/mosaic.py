"""Class scores of one panorama or photo, accumulated image by image.

`tangent_to_labels` wants the scores of all images at once: 5 GB for 13 classes at level 11. Here
they arrive a few images at a time, from any number of grids, and are not kept. Without averaging,
only the labels are kept.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from tangent_train.rendering import kernels
from tangent_train.rendering.accumulate import NO_OWNERS, add_to_panorama, label_panorama, zero_sums
from tangent_train.rendering.checks import check_blend
from tangent_train.rendering.compiled import over_rows
from tangent_train.rendering.sampling import plane_rays
from tangent_train.rendering.tables import owners

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.geometry import PinholeGrid
    from tangent_train.rendering.backward import Blend
    from tangent_train.rendering.representations.perspective import PhotoCrops


class ScoreMosaic:
    """Scores of K classes at every pixel of a panorama or photo.

    Args:
        shape: ``(H, W)``.
        num_classes: K.
        blend: ``nearest``: a pixel takes the scores of the image that owns it, as in
            `tangent_to_labels`. ``feather``: the weighted average of the probabilities of all
            images that see it.
        averaged: Whether to keep sums of probabilities: always with ``feather``; with ``nearest``
            for more than one grid, or when the probabilities are wanted. They take 4 K bytes a
            pixel, K rounded up to 16s, beyond 2 GiB in a temporary file (of the folder TMPDIR).
        min_confidence: Probability from which the best class is certain, see `labels`; above 0,
            sums are kept.
        spare: `sums` of a mosaic that nobody uses any more, to take its memory.

    Attributes:
        shape: As given.
        blend: As given.
        sums: Of probabilities, from `zero_sums`; empty where they are not kept.

    Raises:
        SettingError: The temporary file for the sums does not fit on the disk.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        num_classes: int,
        blend: Blend,
        *,
        averaged: bool = False,
        min_confidence: float = 0.0,
        spare: NDArray[np.float32] | None = None,
    ) -> None:
        self.shape = shape
        self.blend = blend
        self._labels = np.zeros(shape, np.uint8 if num_classes < 256 else np.uint16)
        averaged = averaged or blend == "feather" or min_confidence > 0
        self._num_classes = num_classes
        self._min_confidence = min_confidence
        self.sums = zero_sums(shape if averaged else (0, 0), num_classes, spare)
        self._owned: tuple[object, NDArray[np.integer]] = None, NO_OWNERS

    def add(self, scores: Tensor, grid: PinholeGrid, faces: NDArray[np.int64]) -> None:
        """Add some images of a grid; every face must be added once.

        Args:
            scores: ``(n, K, d, d)`` scores, not probabilities.
            grid: Their grid.
            faces: ``(n,)`` which images they are.

        Raises:
            SettingError: The images of the grid do not overlap, as `feather` needs.
        """
        check_blend(self.blend, grid)
        owner = self._owners(grid, lambda: owners(grid, self.shape))
        images = _on_cpu(scores), grid, faces
        if len(self.sums):
            everywhere = self.shape, slice(0, self.shape[0])
            add_to_panorama(*images, *everywhere, owner, self.sums, softmax=True)
        else:
            label_panorama(*images, owner, self._labels)

    def add_crops(self, scores: Tensor, crops: PhotoCrops, which: NDArray[np.int64]) -> None:
        """Add some crops of a photo; each must be added once.

        Args:
            scores: ``(n, K, h, w)`` scores, not probabilities.
            crops: Positions of all crops.
            which: ``(n,)`` which of them these are.
        """
        height, width = self.shape
        prepared = _on_cpu(scores)
        views, spans = np.zeros((len(which), 3, 3)), np.zeros((len(which), height, 2), np.int32)
        for number, box in enumerate(crops.boxes[which]):
            left, top, right, bottom = box
            across, down = prepared.shape[3] / (right - left), prepared.shape[2] / (bottom - top)
            # Of the ray (j, 1, i): pixel j of the photo is at j + ½ from its corner.
            views[number] = [
                [across, (0.5 - left) * across - 0.5, 0],
                [0, (0.5 - top) * down - 0.5, down],
                [0, 1, 0],
            ]
            first, last = max(0, math.floor(left)), min(width, math.ceil(right))
            spans[number, max(0, math.floor(top)) : math.ceil(bottom)] = first, last - first
        rays = plane_rays(self.shape)
        owner = self._owners(crops, lambda: crops.owners(self.shape))
        sight = kernels.Sight(which, views, spans, *rays, owner)
        if len(self.sums):
            arguments = (prepared, sight, True, self.sums, self._labels)
            over_rows(kernels.add_images, height, width, *arguments)
        else:
            over_rows(kernels.label_images, height, width, prepared, sight, self._labels)

    def labels(self) -> NDArray[np.unsignedinteger]:
        """``(H, W)`` places of the best classes, of equal ones the first; K where unsure."""
        if len(self.sums):
            least = self._min_confidence
            arguments = (self.sums, self._num_classes, least, self._labels)
            over_rows(kernels.best_classes, *self.shape, *arguments)
        return self._labels

    def probabilities(self, rows: slice | NDArray[np.intp]) -> NDArray[np.float32]:
        """``(h, W, K)`` probabilities of some rows, which add up to 1; only where averaged."""
        total = self.sums[rows][..., : self._num_classes]
        return total / np.maximum(total.sum(axis=-1, keepdims=True), np.float32(1e-37))

    def _owners(
        self, images: object, build: Callable[[], NDArray[np.integer]]
    ) -> NDArray[np.integer]:
        """Owner of each pixel, kept until images of another set are added."""
        if self.blend == "feather":
            return NO_OWNERS
        if self._owned[0] is not images:
            self._owned = images, build()
        return self._owned[1]


def _on_cpu(scores: Tensor) -> NDArray[np.float32]:
    result: NDArray[np.float32] = scores.detach().float().contiguous().cpu().numpy()
    return result
