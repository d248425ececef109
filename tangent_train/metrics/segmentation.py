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
    boundary_sums,
    right,
    row_weights,
    seam_sums,
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
        solid_angle: ``(K+1, K+1)`` steradians of panoramas; all 0 for photos.
        bands: ``(6, K+1, K+1)`` pixels of panoramas in the latitude bands `BAND_EDGES_DEG`.
        of_images: ``(images, 2, 3, K)`` sums from which each image's scores follow, in pixels and
            in steradians: labeled area, predicted area and hits of each class.
        regions: ``(images, 5, 3, K)`` the same in steradians of the `REGIONS` of panoramas, and
            near boundaries, see `boundary_sums`; no images if they are photos.
        seam: ``(images, 6)`` see `seam_sums`.
    """

    pixels: Any
    solid_angle: Any
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
    pairs = torch.add(_checked(prediction, k), _checked(truth, k), alpha=k)
    bands = torch.zeros((len(BAND_EDGES_DEG) - 1, k, k), dtype=torch.int64, device=truth.device)
    if truth.ndim != 2:
        pixels = _counted(pairs[None], k)[0]
        steradians = torch.zeros_like(pixels, dtype=torch.float64)
        regions = steradians.new_zeros((0, len(REGIONS) + 1, 3, k - 1))
        seam = steradians.new_zeros((0, SEAM_SUMS))
    else:
        height, width = truth.shape
        weights = torch.as_tensor(
            np.stack([equirect_solid_angles((height, width)), *row_weights(height)])
        ).to(truth.device)
        band, beside = (
            torch.as_tensor(places, device=truth.device)
            for places in (band_of_rows(height), beside_seam(width))
        )
        by_angle = weights.new_zeros((len(weights) + 1, k, k))
        step = max(1, _COUNTS_AT_ONCE // k**2)
        # Integer counts first, so that results do not depend on the order or the device.
        for part in (slice(top, top + step) for top in range(0, height, step)):
            of_rows, of_seam = _counted(pairs[part], k), _counted(pairs[part][:, beside], k)
            bands.index_add_(0, band[part], of_rows)
            by_angle[:-1] += torch.tensordot(weights[:, part], of_rows.double(), dims=1)
            by_angle[-1] += torch.tensordot(weights[0, part], of_seam.double(), dims=1)
        pixels, (steradians, poles, horizon, seam_zone) = bands.sum(dim=0), by_angle
        matrices = poles, horizon, seam_zone, steradians - seam_zone
        maps = [labels.cpu().numpy().astype(np.uint8) for labels in (prediction, truth)]
        edges = torch.from_numpy(boundary_sums(maps[0], maps[1], k)).to(truth.device)
        of_regions = [torch.stack(_class_sums(matrix)) for matrix in matrices]
        regions = torch.stack([*of_regions, edges])[None]
        known = maps[1] > UNKNOWN
        changes = [labels != right(labels) for labels in maps]
        at_seam = seam_sums(changes[0], changes[1], known & right(known))
        seam = torch.from_numpy(at_seam)[None]
    sums = [torch.stack(_class_sums(matrix.double())) for matrix in (pixels, steradians)]
    counts = pixels, steradians, bands, torch.stack(sums)[None], regions, seam.to(truth.device)
    return SegmentationCounts(*counts)


def _counted(pairs: Tensor, num_classes: int) -> Tensor:
    """Count pairs ``(n, …)`` in n matrices; those of unknown pixels are left out."""
    k, rows = num_classes, torch.arange(len(pairs), device=pairs.device, dtype=torch.int32)
    flat = (pairs.flatten(1) + (rows * k * k)[:, None]).flatten()
    counts = torch.bincount(flat, minlength=len(pairs) * k * k).reshape(-1, k, k)
    counts[:, UNKNOWN] = 0
    return counts


def _checked(indices: Tensor, num_classes: int) -> Tensor:
    indices = indices.int()
    least, greatest = map(int, indices.aminmax()) if indices.numel() else (0, 0)
    if least < 0 or greatest >= num_classes:
        raise SettingError(
            "class index", found=f"{least} to {greatest}", expected=f"0 to {num_classes - 1}"
        )
    return indices
