"""Measures that only panoramas have: seam, poles, and boundaries of classes.

* **Seam**: neighbors across ±180° disagree more than others if a program treats the left and the
  right edge as borders. The *seam step* is the mean disagreement of these neighbors, minus that of
  the neighbors across all other meridians, both minus the disagreement of the ground truth. It is
  the share of unequal labels, or the mean of ``|ln d − ln d'|`` of distances. Pairs count by the
  solid angle of their rows.
* **Regions**, by solid angle: within 30° of the poles, within 30° of the horizon, within 5 % of the
  width of the seam, and elsewhere.
* **Boundary IoU** (Cheng et al., CVPR 2021): the IoU of the parts of a class, in the prediction and
  in the ground truth, that are close to another label of the same image.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_solid_angles

REGIONS = ("poles", "horizon", "seam", "elsewhere")
SEAM_SUMS = 6

_CAP_DEG = 30
_SEAM_SHARE = 0.05
BOUNDARY_DEG = 1.0
"""Width of the boundaries of classes, in degrees; at least one pixel."""


def row_weights(height: int) -> NDArray[np.float64]:
    """Return the solid angles ``(2, H)`` of the rows of the first two of `REGIONS`."""
    latitudes_deg = np.abs(90 - (2 * np.arange(height) + 1) * 90 / height)
    rows = np.stack([latitudes_deg > 90 - _CAP_DEG, latitudes_deg < _CAP_DEG])
    return rows * equirect_solid_angles((height, 2 * height))


def beside_seam(width: int) -> NDArray[np.intp]:
    """Return the columns beside the seam."""
    beside = max(1, round(_SEAM_SHARE * width))
    return np.r_[0:beside, width - beside : width]


def seam_sums(
    predicted: NDArray[Any], true: NDArray[Any], known: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Sum the disagreement of neighbors in a row, see `seam_step`.

    Args:
        predicted: ``(H, W)`` disagreement of each pixel with its right neighbor.
        true: The same in the ground truth.
        known: True where both pixels of a pair are known.

    Returns:
        ``(6,)`` predicted and true disagreement and weight of the pairs across the seam; those of
        others.
    """
    angles = equirect_solid_angles(known.shape)
    across, others = [], []
    for values in (predicted, true, known):
        counted = values & known if values.dtype == np.bool_ else np.where(known, values, 0)
        across.append(angles @ counted[:, -1])
        others.append(angles @ counted[:, :-1].sum(axis=1))
    return np.array([*across, *others])


def seam_step(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the seam step, given results ``(…, 6)`` of `seam_sums`; NaN without known pairs."""
    parts = sums.reshape(*sums.shape[:-1], 2, 3)
    excess = (parts[..., 0] - parts[..., 1]) / np.where(parts[..., 2] > 0, parts[..., 2], np.nan)
    step: NDArray[np.float64] = excess[..., 0] - excess[..., 1]
    return step


def right(values: NDArray[Any]) -> NDArray[Any]:
    """Return the right neighbors of pixels ``(H, W)``."""
    return np.concatenate([values[:, 1:], values[:, :1]], axis=1)


def near_boundary(labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return a mask of the pixels close to another label, ``(H, W)``.

    Close is a neighborhood of `BOUNDARY_DEG` in latitude and, along the parallel of the pixel, in
    longitude: ``1 / cos φ`` times as many columns.

    Args:
        labels: ``(H, W)`` labels of a panorama.
    """
    height, width = labels.shape
    down, across = _reach(height, width)
    # Beyond a pole, rows continue half a revolution away.
    beyond = [np.roll(part[::-1], width // 2, axis=1) for part in (labels[:down], labels[-down:])]
    tall = np.concatenate([beyond[0], labels, beyond[1]])
    column = np.ones((2 * down + 1, 1), np.uint8)
    least, most = (morph(tall, column)[down:-down] for morph in (cv2.erode, cv2.dilate))
    # Another label is close if the labels above and below a close pixel, or those of two neighbors
    # along the parallel, are not all the same.
    alone = (least != most).view(np.uint8)
    pairs = alone | (least != right(least))
    near, starts = np.empty((height, width), np.bool_), np.flatnonzero(np.diff(across)) + 1
    for top, bottom in itertools.pairwise([0, *starts.tolist(), height]):
        reach = int(across[top])
        beside = (0, 0, reach, reach, cv2.BORDER_WRAP)
        wide = [cv2.copyMakeBorder(part[top:bottom], *beside) for part in (alone, pairs)]
        counts = cv2.boxFilter(
            wide[1], cv2.CV_32S, (2 * reach, 1), anchor=(reach, 0), normalize=False
        )
        near[top:bottom] = counts[:, reach:-reach]
        near[top:bottom] |= wide[0][:, 2 * reach :].view(np.bool_)
    return near


@lru_cache(maxsize=4)
def _reach(height: int, width: int) -> tuple[int, NDArray[np.intp]]:
    """Return the rows, and the columns in each row, within `BOUNDARY_DEG`."""
    down = max(1, round(BOUNDARY_DEG * height / 180))
    latitudes = math.pi / 2 - (2 * np.arange(height) + 1) * math.pi / (2 * height)
    across = np.rint(BOUNDARY_DEG * width / 360 / np.cos(latitudes))
    return down, across.clip(1, width // 2).astype(np.intp)


def boundary_sums(
    prediction: NDArray[np.uint8], truth: NDArray[np.uint8], num_classes: int
) -> NDArray[np.float64]:
    """Return the steradians ``(3, K)`` of classes near boundaries: true, predicted, and both.

    Args:
        prediction: ``(H, W)`` labels.
        truth: ``(H, W)`` labels; 0 is unknown: not counted, and another label beside a class.
        num_classes: K + 1, the unknown class 0 included.
    """
    height, width = truth.shape
    angles, known = equirect_solid_angles((height, width)), truth > 0
    prediction = np.where(known, prediction, truth)
    near_true, near_predicted = near_boundary(truth) & known, near_boundary(prediction) & known
    both = near_true & near_predicted & (truth == prediction)
    sums = []
    for labels, mask in ((truth, near_true), (prediction, near_predicted), (truth, both)):
        rows = np.repeat(np.arange(height) * num_classes, np.count_nonzero(mask, axis=1))
        counts = np.bincount(rows + labels[mask], minlength=height * num_classes)
        sums.append(angles @ counts.reshape(height, num_classes)[:, 1:])
    return np.stack(sums)
