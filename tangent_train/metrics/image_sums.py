"""Scores of a data set, from numbers of each image that are summed over the images.

Sums of all images give the scores, sums of some images those of a group, and sums of images that
are drawn with replacement their 95 % percentile bootstrap intervals, with images as the unit (Efron
and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13). The draws depend only on the
number of images. The difference of two evaluations of the same images, in the same order, is thus
paired: each draw scores the same images for both.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from tangent_train.metrics.panoptic import panoptic_scores
from tangent_train.metrics.scores import Interval, by_solid_angle, defined_mean

AbsentClass = Literal["skip", "zero"]
"""Treatment of a class without labeled pixels: left out of means, or counted as 0."""

Sums = Mapping[str, NDArray[np.float64]]
"""Numbers of images ``(images, …)``, or their sums. Of classes: ``pixels``, and of panoramas
``solid_angle``, ``regions`` and ``seam``, see `SegmentationCounts`. Of panoptic maps: ``things``
and ``stuff``, see `panoptic_scores`. Each other score has two numbers: its value and 1, or 0 and 0
if it is undefined."""


def as_sums(scores: Mapping[str, Float[np.ndarray, " images"]]) -> Sums:
    """Return numbers of images whose sums give the means of scores; NaN is left out."""
    return {
        name: np.stack([np.nan_to_num(values, nan=0.0), ~np.isnan(values)], axis=1)
        for name, values in scores.items()
    }


def scores_of_sums(sums: Sums, absent_class: str = "skip") -> dict[str, NDArray[np.float64]]:
    """Compute the scores of data sets ``(…)`` from their sums ``(…, …)``.

    Args:
        sums: Sums over the images of each data set.
        absent_class: See `AbsentClass`.

    Returns:
        Scores by name; NaN where they are undefined.
    """
    if "things" in sums:
        return panoptic_scores(sums["things"], sums["stuff"])
    of_classes = "pixels", "solid_angle", "regions", "seam"
    pairs = {name: of for name, of in sums.items() if name not in of_classes}
    numbers = {name: np.where(of[..., 1] > 0, of[..., 1], np.nan) for name, of in pairs.items()}
    scores = {name: sums[name][..., 0] / number for name, number in numbers.items()}
    if "pixels" not in sums:
        return scores
    scores |= mean_scores(sums["pixels"], absent_class)
    if "seam" not in sums:
        return scores
    regions = mean_scores(sums["regions"], absent_class)["miou"]
    poles, horizon, near, others, boundaries = np.moveaxis(regions, -1, 0)
    gaps = {"pole_gap": poles - horizon, "seam_gap": near - others}
    of_sphere = {"boundary_miou": boundaries, **gaps, "seam_step": seam_step(sums["seam"])}
    return scores | by_solid_angle(mean_scores(sums["solid_angle"], absent_class)) | of_sphere


def means_of_sums(
    sums: Sums, absent_class: str = "skip", places: Any = slice(None)
) -> dict[str, float]:
    """Return the scores over all images, or over those at some places, see `scores_of_sums`."""
    total = {name: values[places].sum(axis=0) for name, values in sums.items()}
    return {name: float(score) for name, score in scores_of_sums(total, absent_class).items()}


def class_scores(
    sums: Float[np.ndarray, "*some 3 classes"], absent_class: str
) -> dict[str, Float[np.ndarray, "*some classes"]]:
    """Return IoU and accuracy, given labeled area, predicted area and hits of each class."""
    truth, predicted, hits = np.moveaxis(sums, -2, 0)
    missing = np.nan if absent_class == "skip" else 0.0
    areas = {"iou": truth + predicted - hits, "accuracy": truth}
    return {
        name: np.where(truth > 0, hits / np.maximum(area, 1e-300), missing)
        for name, area in areas.items()
    }


def seam_step(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the seam step, given results ``(…, 6)`` of `seam_sums`; NaN without known pairs."""
    parts = sums.reshape(*sums.shape[:-1], 2, 3)
    excess = (parts[..., 0] - parts[..., 1]) / np.where(parts[..., 2] > 0, parts[..., 2], np.nan)
    step: NDArray[np.float64] = excess[..., 0] - excess[..., 1]
    return step


def mean_scores(
    sums: Float[np.ndarray, "*some 3 classes"], absent_class: str = "skip"
) -> dict[str, NDArray[np.float64]]:
    """Return mIoU and mAcc, given labeled area, predicted area and hits of each class."""
    scores = class_scores(sums, absent_class)
    return {"miou": defined_mean(scores["iou"]), "macc": defined_mean(scores["accuracy"])}


def drawn_scores(
    sums: Sums, absent_class: str = "skip", draws: int = 1000, seed: int = 0
) -> dict[str, Float[np.ndarray, " draws"]]:
    """Return the scores of data sets of as many images, drawn with replacement.

    Args:
        sums: Numbers of each image.
        absent_class: See `AbsentClass`.
        draws: Number of data sets.
        seed: Seed of the draws.

    Returns:
        Scores by name; empty for a single image.
    """
    count = min(map(len, sums.values()), default=0)
    if count <= 1:
        return {}
    generator = np.random.default_rng(seed)
    times = generator.multinomial(count, np.full(count, 1 / count), size=draws).astype(np.float64)
    drawn = {name: np.tensordot(times, values, axes=1) for name, values in sums.items()}
    return scores_of_sums(drawn, absent_class)


def intervals(drawn: Mapping[str, Float[np.ndarray, " draws"]]) -> dict[str, Interval]:
    """Return the 95 % percentile intervals of scores, or of differences, see `drawn_scores`.

    Undefined scores have no interval.
    """
    found = {}
    for name, scores in drawn.items():
        if not np.isnan(scores).all():
            low, high = np.nanquantile(scores, (0.025, 0.975))
            found[name] = (float(low), float(high))
    return found
