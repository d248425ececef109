"""Panoptic quality (Kirillov et al., CVPR 2019) of panoramas.

A panoptic map ``(H, W)`` holds ``number + 65536 label`` at each pixel: the number of an object, or
0 for classes that are not counted (stuff); 0 is unknown. In COCO's colors, the label is blue.

Two segments of a class match if their IoU exceeds ½; at most one segment can. As in COCO's code,
what is predicted where the truth is unknown does not count, and a predicted segment that is mostly
unknown is not wrong.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_solid_angles
from tangent_train.metrics.scores import by_solid_angle, defined_mean
from tangent_train.metrics.sphere import row_weights

LABEL = 1 << 16
"""Factor of the label in a panoptic map."""

SUBSETS = ("all", "seam", "poles")
"""All segments; those across ±180°; those with most of their solid angle within 30° of a pole."""

SUMS = ("iou", "matched", "missed", "wrong")
"""Sums of a class: IoU of matches, matches, true segments, and predicted segments without one."""


def panoptic_sums(
    prediction: NDArray[np.integer], truth: NDArray[np.integer], num_classes: int
) -> NDArray[np.float64]:
    """Compare the segments of one panorama, by pixels and by solid angle.

    Args:
        prediction: Panoptic map ``(H, W)``.
        truth: Panoptic map ``(H, W)``.
        num_classes: K + 1, the unknown class 0 included.

    Returns:
        ``(2, 3, K, 4)`` `SUMS` of each class, of `SUBSETS`, by pixels and by solid angle.
    """
    (true, row), (found, column) = (
        np.unique(codes, return_inverse=True) for codes in (truth, prediction)
    )
    (height, width), shape = truth.shape, (len(true), len(found))
    rows = [np.ones(height), equirect_solid_angles(truth.shape), row_weights(height)[0]]
    flat = np.ravel_multi_index((row.ravel(), column.ravel()), shape)
    sums: Any = (
        np.bincount(flat, np.repeat(of_row, width), shape[0] * shape[1]) for of_row in rows
    )
    pixels, by_angle, in_cap = (areas.reshape(shape) for areas in sums)
    subsets = []
    for axis, number in ((1, row), (0, column)):
        left, right = number.reshape(truth.shape)[:, [0, -1]].T
        across = np.isin(np.arange(shape[1 - axis]), left[left == right])
        near_pole = in_cap.sum(axis) > by_angle.sum(axis) / 2
        subsets.append(np.stack([np.ones_like(across), across, near_pole]))
    given = true, found, subsets[0], subsets[1], num_classes
    return np.stack([_sums(areas, *given) for areas in (pixels, by_angle)])


def _sums(
    pairs: NDArray[np.float64], true: Any, found: Any, of_true: Any, of_found: Any, num_classes: int
) -> NDArray[np.float64]:
    """Return ``(3, K, 4)`` sums, given the area of each pair of true and predicted segments.

    Args:
        pairs: ``(n, m)`` areas.
        true: ``(n,)`` codes of true segments; 0 is unknown.
        found: ``(m,)`` codes of predicted segments.
        of_true: ``(3, n)`` subsets.
        of_found: ``(3, m)`` subsets.
        num_classes: K + 1.
    """
    known = true > 0
    unknown_area = pairs[~known].sum(axis=0)
    pairs, true, of_true = pairs[known], true[known], of_true[:, known]
    area = pairs.sum(axis=0) + unknown_area
    iou = pairs / (pairs.sum(axis=1)[:, None] + (area - unknown_area) - pairs)
    iou = iou * (true[:, None] // LABEL == found // LABEL) * (found > 0)
    is_match = iou > 0.5
    matched = is_match.any(axis=1)
    wrong = (found > 0) & ~is_match.any(axis=0) & (unknown_area <= area / 2)
    of_class = [np.eye(num_classes)[codes // LABEL][:, 1:] for codes in (true, found)]
    values = np.stack([(iou * is_match).sum(axis=1), matched, ~matched])
    sums = np.einsum("sn,vn,nk->skv", of_true, values, of_class[0])
    return np.concatenate(
        [sums, np.einsum("sm,m,mk->sk", of_found, wrong, of_class[1])[..., None]], -1
    )


def quality(sums: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return PQ, SQ and RQ of each class, given sums ``(…, 4)``; NaN without segments."""
    iou, matched, missed, wrong = np.moveaxis(sums, -1, 0)
    total = matched + (missed + wrong) / 2
    with np.errstate(invalid="ignore", divide="ignore"):
        return {
            "pq": np.where(total > 0, iou / total, np.nan),
            "sq": np.where(total > 0, iou / np.maximum(matched, 1), np.nan),
            "rq": np.where(total > 0, matched / total, np.nan),
        }


def panoptic_scores(
    things: NDArray[np.float64], stuff: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """Return means over the classes, given sums ``(…, 2, 3, classes, 4)`` of `panoptic_sums`.

    Classes without segments are left out. The PQ of objects at seam and poles, see `SUBSETS`, is by
    solid angle.
    """
    pixels, angles = np.moveaxis(np.concatenate([things, stuff], axis=-2)[..., 0, :, :], -3, 0)
    of_things, of_stuff = (_means(of[..., 0, 0, :, :])["pq"] for of in (things, stuff))
    seam, poles = np.moveaxis(_means(things[..., 1, 1:, :, :])["pq"], -1, 0)
    parts = {"pq_things": of_things, "pq_stuff": of_stuff, "pq_seam": seam, "pq_poles": poles}
    return _means(pixels) | by_solid_angle(_means(angles)) | parts


def _means(sums: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    return {name: defined_mean(of_classes) for name, of_classes in quality(sums).items()}
