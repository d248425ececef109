"""Metrics of torchmetrics: counts and errors of all images, summed or joined over processes.

They are apart from the functions that compute scores, because torchmetrics takes seconds to import
and predictions do not need it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Integer
from numpy.typing import NDArray
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.classification import MulticlassConfusionMatrix
from torchmetrics.utilities import dim_zero_cat

from tangent_train.metrics.depth import SUMS, WEIGHTINGS, error_sums
from tangent_train.metrics.panoptic import SUBSETS, panoptic_sums
from tangent_train.metrics.panoptic import SUMS as SEGMENT_SUMS
from tangent_train.metrics.scores import BAND_EDGES_DEG
from tangent_train.metrics.segmentation import SegmentationCounts, count_image
from tangent_train.metrics.sphere import REGIONS, SEAM_SUMS


class ImagesMetric(Metric):
    """Collects numbers of each image of a data set, on all processes.

    Args:
        **shapes: Shape of the numbers of an image, by the name of the state.
    """

    full_state_update = False
    of_images: list[Tensor]

    def __init__(self, **shapes: tuple[int, ...]) -> None:
        super().__init__()
        self._shapes = shapes
        for name in shapes:
            self.add_state(name, [], dist_reduce_fx="cat")
        self.reset()

    def reset(self) -> None:
        """Forget all images."""
        super().reset()
        # Processes without images contribute an empty part of the same dtype and shape.
        for name, shape in self._shapes.items():
            empty = torch.zeros((0, *shape), dtype=torch.float64, device=self.device)
            setattr(self, name, [empty])

    def compute(self) -> Any:
        """Return the numbers ``(images, …)`` of all processes."""
        return dim_zero_cat(self.of_images).cpu().numpy()


class SegmentationMetric(ImagesMetric):
    """Counts the pixels of all images of a data set, see `SegmentationCounts`.

    Pixels are counted as integers, summed over processes. Equirectangular pixels over-count the
    poles, so that other numbers weight each pixel by its solid angle.

    Args:
        num_classes: K + 1, the unknown class 0 included.
    """

    pixels: Tensor
    bands: Tensor

    def __init__(self, num_classes: int) -> None:
        classes = 3, num_classes - 1
        regions = len(REGIONS) + 1, *classes
        super().__init__(of_images=(2, *classes), regions=regions, seam=(SEAM_SUMS,))
        self.num_classes = k = num_classes
        integers = {"pixels": (k, k), "bands": (len(BAND_EDGES_DEG) - 1, k, k)}
        for name, shape in integers.items():
            self.add_state(name, torch.zeros(shape, dtype=torch.int64), dist_reduce_fx="sum")

    def update(
        self, prediction: Integer[Tensor, "*shape"], truth: Integer[Tensor, "*shape"]
    ) -> None:
        """Count one image, see `count_image`."""
        counts = count_image(prediction, truth, self.num_classes)
        for name in ("pixels", "bands"):
            setattr(self, name, getattr(self, name) + getattr(counts, name))
        for name in self._shapes:
            getattr(self, name).append(getattr(counts, name))

    def compute(self) -> SegmentationCounts:
        """Return the counts of all processes as arrays."""
        states = (dim_zero_cat(getattr(self, name)) for name in SegmentationCounts._fields)
        return SegmentationCounts(*(state.cpu().numpy() for state in states))


class ClassificationMetric(MulticlassConfusionMatrix):
    """Counts images in a confusion matrix ``(K, K)``, summed over processes."""

    def compute(self) -> NDArray[np.int64]:  # type: ignore[override]
        """Return the matrix of all processes; rows are the true classes."""
        counts: NDArray[np.int64] = super().compute().cpu().numpy()
        return counts


class DepthMetric(ImagesMetric):
    """Collects the errors of all images of a data set, see `error_sums`."""

    def __init__(self) -> None:
        super().__init__(of_images=(WEIGHTINGS, SUMS))

    def update(self, prediction: Tensor, truth: Tensor) -> None:
        """Add the errors of one image, see `error_sums`."""
        self.of_images.append(error_sums(prediction, truth)[None])


class PanopticMetric(ImagesMetric):
    """Collects the sums of the segments of all panoramas of a data set, see `panoptic_sums`.

    Args:
        num_classes: K + 1, the unknown class 0 included.
    """

    def __init__(self, num_classes: int) -> None:
        super().__init__(of_images=(2, len(SUBSETS), num_classes - 1, len(SEGMENT_SUMS)))
        self.num_classes = num_classes

    def update(self, prediction: Tensor, truth: Tensor) -> None:
        """Add the panoptic maps of one panorama."""
        maps = prediction.cpu().numpy(), truth.cpu().numpy()
        sums = torch.from_numpy(panoptic_sums(*maps, self.num_classes))
        self.of_images.append(sums[None].to(truth.device))
