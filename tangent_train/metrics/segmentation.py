"""Classes: confusion matrices over the data set, of pixels or of images, and their scores."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Integer
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_solid_angles
from tangent_train.metrics.image_sums import AbsentClass, class_scores, mean_scores
from tangent_train.metrics.scores import BAND_EDGES_DEG, band_of_rows
from tangent_train.metrics.sphere import (
    REGIONS,
    SEAM_SUMS,
    beside_seam,
    count_rows,
    near_boundary,
    row_weights,
)

_COUNTS_AT_ONCE = 2**22
"""Counts of rows of a panorama that are held at once, 32 MiB."""

UNKNOWN = 0
"""Class index of unlabeled pixels in all data sets."""


class SegmentationScores(NamedTuple):
    """Scores of one confusion matrix; classes in order, the unknown class left out.

    Attributes:
        means: Scores over all classes, ``miou`` and ``macc``: the means of those of classes.
        of_classes: ``(K,)`` intersection over union (``iou``), and share of the pixels of a class
            that were predicted correctly (``accuracy``); NaN for absent classes that are skipped.
        share: ``(K,)`` each class's share of the labeled pixels.
    """

    means: dict[str, float]
    of_classes: dict[str, NDArray[np.float64]]
    share: NDArray[np.float64]


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
    means = {name: float(score) for name, score in mean_scores(sums, absent_class).items()}
    share = sums[0] / max(sums[0].sum(), 1e-300)
    return SegmentationScores(means, class_scores(sums, absent_class), share)


def _class_sums(confusion: Any) -> tuple[Any, Any, Any]:
    """Return labeled pixels, predicted pixels and hits of each class (array or tensor)."""
    known = confusion[1:]
    return known.sum(1), known[:, 1:].sum(0), known[:, 1:].diagonal()


class SegmentationCounts(NamedTuple):
    """Confusion matrices of images; rows are the true classes, class 0 is unknown.

    Attributes:
        pixels: ``(K+1, K+1)`` pixels of panoramas and photos.
        bands: ``(6, K+1, K+1)`` pixels of panoramas in the latitude bands `BAND_EDGES_DEG`.
        of_images: ``(images, 2, 3, K)`` sums from which each image's scores follow, in pixels and
            in steradians: labeled area, predicted area and hits of each class.
        regions: ``(images, 5, 3, K)`` the same in steradians of the `REGIONS` of panoramas, and
            near boundaries, see `boundary_sums`; no images if they are photos.
        seam: ``(images, 6)`` see `seam_sums`.
    """

    pixels: Any
    bands: Any
    of_images: Any
    regions: Any
    seam: Any


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
        SettingError: A class index is out of range.
    """
    k = num_classes
    for labels in (prediction, truth):
        _check(labels, k)
    if truth.ndim != 2:
        pixels = confusion(prediction, truth, k)
        bands = pixels.new_zeros((len(BAND_EDGES_DEG) - 1, k, k))
        steradians = torch.zeros_like(pixels, dtype=torch.float64)
        regions = steradians.new_zeros((0, len(REGIONS) + 1, 3, k - 1))
        seam = steradians.new_zeros((0, SEAM_SUMS))
    else:
        bands, by_angle, edges, seam = _count_panorama(prediction, truth, k)
        pixels, (steradians, poles, horizon, seam_zone) = bands.sum(dim=0), by_angle
        matrices = poles, horizon, seam_zone, steradians - seam_zone
        of_regions = [torch.stack(_class_sums(matrix)) for matrix in matrices]
        regions = torch.stack([*of_regions, edges])[None]
    sums = [torch.stack(_class_sums(matrix.double())) for matrix in (pixels, steradians)]
    counts = pixels, bands, torch.stack(sums)[None], regions, seam
    return SegmentationCounts(*(part.to(truth.device) for part in counts))


def _count_panorama(prediction: Tensor, truth: Tensor, k: int) -> tuple[Tensor, ...]:
    """Count the pixels of one panorama, on the CPU.

    Returns:
        Pixels ``(6, K+1, K+1)`` of `SegmentationCounts.bands`; steradians ``(4, K+1, K+1)`` of all
        pixels, near the poles, near the horizon and beside the seam; those near boundaries ``(3,
        K)``; and `SegmentationCounts.seam`.
    """
    labels = [part.to("cpu", torch.uint8).contiguous().numpy() for part in (prediction, truth)]
    height, width = truth.shape
    angles, beside = equirect_solid_angles((height, width)), len(beside_seam(width)) // 2
    weights = torch.from_numpy(np.stack([angles, *row_weights(height)]))
    band, by_angle = torch.from_numpy(band_of_rows(height)), weights.new_zeros((4, k, k))
    bands = torch.zeros((len(BAND_EDGES_DEG) - 1, k, k), dtype=torch.int64)
    near = [near_boundary(np.where(labels[1] > UNKNOWN, *labels)), near_boundary(labels[1])]
    edges, changes = np.zeros((3, height, k), np.int64), np.zeros((6, height), np.int64)
    step = max(1, _COUNTS_AT_ONCE // k**2)
    # Integer counts first, so that results do not depend on the order.
    for part in (slice(top, top + step) for top in range(0, height, step)):
        pairs = np.zeros((2, len(labels[1][part]), k, k), np.int64)
        maps = tuple(one[part] for one in (*labels, *near))
        count_rows(maps, beside, pairs, edges[:, part], changes[:, part])
        of_rows, of_seam = torch.from_numpy(pairs)
        bands.index_add_(0, band[part], of_rows)
        by_angle[:-1] += torch.tensordot(weights[:, part], of_rows.double(), dims=1)
        by_angle[-1] += torch.tensordot(weights[0, part], of_seam.double(), dims=1)
    of_edges = np.stack([angles @ counts[:, 1:] for counts in edges])
    seam = np.array([angles @ counts for counts in changes])
    return bands, by_angle, torch.from_numpy(of_edges), torch.from_numpy(seam)[None]


def confusion(prediction: Tensor, truth: Tensor, k: int) -> Tensor:
    """Count the pixels of known classes."""
    pairs = torch.add(prediction.int(), truth.int(), alpha=k).flatten()
    counts = torch.bincount(pairs, minlength=k * k).reshape(k, k)
    counts[UNKNOWN] = 0
    return counts


def _check(indices: Tensor, num_classes: int) -> None:
    least, greatest = map(int, indices.aminmax()) if indices.numel() else (0, 0)
    if least < 0 or greatest >= num_classes:
        raise SettingError(
            "class index", found=f"{least} to {greatest}", expected=f"0 to {num_classes - 1}"
        )
