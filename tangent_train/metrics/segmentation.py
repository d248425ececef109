"""Segmentation: one confusion matrix over the data set, and scores computed from it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Integer
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_solid_angles

AbsentClass = Literal["skip", "zero"]
"""Treatment of a class without labeled pixels: left out of means, or counted as 0."""

UNKNOWN = 0
"""Class index of unlabeled pixels in all data sets."""

BAND_EDGES_DEG = (90, 60, 30, 0, -30, -60, -90)
"""Edges of the latitude bands, from north to south. A row whose center is on an edge belongs to the
northern band."""

Interval = tuple[float, float]
"""Lower and upper end of a score, shares of 1."""

_DRAWS_AT_ONCE = 100


class SegmentationScores(NamedTuple):
    """Scores of one confusion matrix; classes in order, the unknown class left out.

    Attributes:
        miou: Mean of `iou`.
        macc: Mean of `accuracy`.
        iou: ``(K,)`` intersection over union; NaN for absent classes that are skipped.
        accuracy: ``(K,)`` share of each class's pixels that were predicted correctly.
        share: ``(K,)`` each class's share of the labeled pixels.
    """

    miou: float
    macc: float
    iou: NDArray[np.float64]
    accuracy: NDArray[np.float64]
    share: NDArray[np.float64]

    @property
    def means(self) -> dict[str, float]:
        """Scores over all classes by name."""
        return {"miou": self.miou, "macc": self.macc}

    @property
    def of_classes(self) -> dict[str, NDArray[np.float64]]:
        """Scores of the classes by name."""
        return {"iou": self.iou, "accuracy": self.accuracy}


def segmentation_scores(
    confusion: ArrayLike, absent_class: AbsentClass = "skip"
) -> SegmentationScores:
    """Compute segmentation scores of a whole data set.

    Args:
        confusion: ``(K+1, K+1)`` counts or weights; rows are the true classes, columns the
            predicted ones. Class 0 is unknown; pixels of this true class are ignored.
        absent_class: `skip` leaves classes absent from the ground truth out of the means; `zero`
            counts them as 0, as the paper's released code does.

    Returns:
        The scores; means are NaN if no pixel is labeled and absent classes are skipped.
    """
    sums = np.stack(_class_sums(np.asarray(confusion, np.float64)))
    iou, accuracy = _class_scores(sums, absent_class)
    truth = sums[0]
    share = truth / truth.sum() if truth.any() else np.zeros_like(truth)
    miou, macc = float(defined_mean(iou)), float(defined_mean(accuracy))
    return SegmentationScores(miou, macc, iou, accuracy, share)


def _class_sums(confusion: Any) -> tuple[Any, Any, Any]:
    """Return labeled pixels, predicted pixels and hits of each class (array or tensor)."""
    known = confusion[1:]
    return known.sum(1), known[:, 1:].sum(0), known[:, 1:].diagonal()


def _class_scores(
    sums: NDArray[np.float64], absent_class: AbsentClass
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return IoU and accuracy ``(..., K)``, given the sums ``(..., 3, K)``."""
    truth, predicted, hits = np.moveaxis(sums, -2, 0)
    missing = np.nan if absent_class == "skip" else 0.0
    iou = hits / np.maximum(truth + predicted - hits, 1e-300)
    accuracy = hits / np.maximum(truth, 1e-300)
    return np.where(truth > 0, iou, missing), np.where(truth > 0, accuracy, missing)


def defined_mean(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over the last axis without NaN; NaN if all values are NaN."""
    count = np.sum(~np.isnan(scores), axis=-1)
    total = np.nansum(scores, axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def mean_scores(
    sums: Float[np.ndarray, "*some 3 classes"], absent_class: AbsentClass = "skip"
) -> dict[str, Any]:
    """Return mIoU and mAcc, given labeled area, predicted area and hits of each class."""
    scores = zip(("miou", "macc"), _class_scores(sums, absent_class), strict=True)
    return {name: defined_mean(of_classes) for name, of_classes in scores}


def bootstrap_intervals(
    of_images: Float[np.ndarray, "images 3 classes"],
    absent_class: AbsentClass = "skip",
    draws: int = 1000,
    seed: int = 0,
) -> dict[str, Interval]:
    """Compute 95 % percentile bootstrap intervals of mIoU and mAcc, with images as the unit.

    Each draw samples as many images as there are, with replacement, and scores them as one data set
    (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13). The result does not
    depend on the order of the images or the number of processes.

    Args:
        of_images: The half of `SegmentationCounts.of_images` for pixels or for solid angles.
        absent_class: Treatment of classes absent from the ground truth of a draw.
        draws: Number of draws.
        seed: Seed of the draws.

    Returns:
        Intervals of ``miou`` and ``macc``; empty for a single image, or without labeled pixels.
    """
    return bootstrap(of_images, partial(mean_scores, absent_class=absent_class), draws, seed)


def bootstrap(
    of_images: Float[np.ndarray, "images ..."],
    score: Callable[[NDArray[np.float64]], Mapping[str, NDArray[np.float64]]],
    draws: int = 1000,
    seed: int = 0,
) -> dict[str, Interval]:
    """Compute 95 % percentile bootstrap intervals of scores, see `bootstrap_intervals`.

    Args:
        of_images: Numbers of each image from whose sums the scores follow.
        score: Function that returns scores ``(draws,)`` by name, given sums ``(draws, …)``.
        draws: Number of draws.
        seed: Seed of the draws.

    Returns:
        Intervals by name; empty for a single image. Undefined scores have no interval.
    """
    count = len(of_images)
    if count <= 1:
        return {}
    flat = of_images.reshape(count, -1)
    flat = flat[np.lexsort(flat.T)]
    generator = np.random.default_rng(seed)
    drawn = []
    for start in range(0, draws, _DRAWS_AT_ONCE):
        size = min(_DRAWS_AT_ONCE, draws - start)
        times = generator.multinomial(count, np.full(count, 1 / count), size=size)
        drawn.append(times.astype(np.float64) @ flat)
    sums = np.concatenate(drawn).reshape(draws, *of_images.shape[1:])
    intervals = {}
    for name, means in score(sums).items():
        if not np.isnan(means).all():
            low, high = np.nanquantile(means, (0.025, 0.975))
            intervals[name] = (float(low), float(high))
    return intervals


class SegmentationCounts(NamedTuple):
    """Confusion matrices of images; rows are the true classes, class 0 is unknown.

    Attributes:
        pixels: ``(K+1, K+1)`` pixels of panoramas and photos.
        solid_angle: ``(K+1, K+1)`` steradians of panoramas; all 0 for photos.
        bands: ``(6, K+1, K+1)`` pixels of panoramas in the latitude bands `BAND_EDGES_DEG`.
        of_images: ``(images, 2, 3, K)`` sums from which each image's scores follow, in pixels and
            in steradians: labeled area, predicted area and hits of each class.
    """

    pixels: Any
    solid_angle: Any
    bands: Any
    of_images: Any


def count_image(
    prediction: Integer[Tensor, "*shape"], truth: Integer[Tensor, "*shape"], num_classes: int
) -> SegmentationCounts:
    """Count the pixels of one panorama ``(H, W)``, or of the crops of one photo ``(n, h, w)``.

    Args:
        prediction: Class indices.
        truth: Class indices; pixels with 0 (unknown) are ignored.
        num_classes: K + 1, the unknown class 0 included.

    Returns:
        The counts as tensors.

    Raises:
        SettingError: The shapes differ, or a class index is out of range.
    """
    if prediction.shape != truth.shape:
        raise SettingError("prediction", found=tuple(prediction.shape), expected=tuple(truth.shape))
    known, k = truth != UNKNOWN, num_classes
    pairs = _checked(truth[known], k) * k + _checked(prediction[known], k)
    bands = pairs.new_zeros((len(BAND_EDGES_DEG) - 1, k, k))
    if truth.ndim == 2:
        height, width = truth.shape
        rows = known.nonzero()[:, 0]
        # Integer counts first, so that results do not depend on the order or the device.
        by_row = torch.bincount(rows * k * k + pairs, minlength=height * k * k)
        by_row = by_row.reshape(height, k, k)
        bands.index_add_(0, torch.as_tensor(band_of_rows(height), device=truth.device), by_row)
        angles = torch.as_tensor(equirect_solid_angles((height, width)), device=truth.device)
        pixels, steradians = by_row.sum(dim=0), torch.tensordot(angles, by_row.double(), dims=1)
    else:
        pixels = torch.bincount(pairs, minlength=k * k).reshape(k, k)
        steradians = torch.zeros_like(pixels, dtype=torch.float64)
    sums = [torch.stack(_class_sums(matrix.double())) for matrix in (pixels, steradians)]
    return SegmentationCounts(pixels, steradians, bands, torch.stack(sums)[None])


def band_of_rows(height: int) -> NDArray[np.intp]:
    """Return the index of the latitude band of each row of a panorama, see `BAND_EDGES_DEG`."""
    # In degrees, with the division last, so that a row on an edge has no rounding error.
    southward_deg = (2 * np.arange(height) + 1) * 90 / height - 90
    return np.searchsorted(-np.array(BAND_EDGES_DEG[1:-1]), southward_deg, side="left")


class ImagesMetric(Metric):
    """Collects numbers of each image of a data set, on all processes.

    Args:
        *shape: Shape of the numbers of an image.
    """

    full_state_update = False
    of_images: list[Tensor]

    def __init__(self, *shape: int) -> None:
        super().__init__()
        self._shape = shape
        self.add_state("of_images", [], dist_reduce_fx="cat")
        self.reset()

    def reset(self) -> None:
        """Forget all images."""
        super().reset()
        # Processes without images contribute an empty part of the same dtype and shape.
        empty = torch.zeros((0, *self._shape), dtype=torch.float64, device=self.device)
        self.of_images = [empty]


class SegmentationMetric(ImagesMetric):
    """Counts the pixels of all images of a data set, see `SegmentationCounts`.

    Pixels are integer counts. Equirectangular pixels over-count the poles; in the matrix of solid
    angles each pixel has the weight of its solid angle. Counts are summed over processes.

    Args:
        num_classes: K + 1, the unknown class 0 included.
    """

    pixels: Tensor
    solid_angle: Tensor
    bands: Tensor

    def __init__(self, num_classes: int) -> None:
        super().__init__(2, 3, num_classes - 1)
        self.num_classes = k = num_classes
        integers = {"pixels": (k, k), "bands": (len(BAND_EDGES_DEG) - 1, k, k)}
        for name, shape in integers.items():
            self.add_state(name, torch.zeros(shape, dtype=torch.int64), dist_reduce_fx="sum")
        zeros = torch.zeros((k, k), dtype=torch.float64)
        self.add_state("solid_angle", zeros, dist_reduce_fx="sum")

    def update(
        self, prediction: Integer[Tensor, "*shape"], truth: Integer[Tensor, "*shape"]
    ) -> None:
        """Count one image, see `count_image`."""
        counts = count_image(prediction, truth, self.num_classes)
        for name in ("pixels", "solid_angle", "bands"):
            setattr(self, name, getattr(self, name) + getattr(counts, name))
        self.of_images.append(counts.of_images)

    def compute(self) -> SegmentationCounts:
        """Return the counts of all processes as arrays."""
        states = (dim_zero_cat(getattr(self, name)) for name in SegmentationCounts._fields)
        return SegmentationCounts(*(state.cpu().numpy() for state in states))


def _checked(indices: Tensor, num_classes: int) -> Tensor:
    least, greatest = map(int, indices.aminmax()) if indices.numel() else (0, 0)
    if least < 0 or greatest >= num_classes:
        raise SettingError(
            "class index", found=f"{least} to {greatest}", expected=f"0 to {num_classes - 1}"
        )
    return indices.long()
