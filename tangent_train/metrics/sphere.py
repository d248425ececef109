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

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_solid_angles
from tangent_train.rendering.kernels import Array, njit_exact

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
    """Sum the disagreement of neighbors in a row, see `metrics.image_sums.seam_step`.

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
    near = np.zeros((height, width), np.bool_)
    _mark(np.concatenate([beyond[0], labels, beyond[1]]), down, across, near)
    return near


@njit_exact
def _mark(tall: Array, down: int, across: Array, near: Array) -> None:
    """Mark pixels near boundaries; see `near_boundary`."""
    width = near.shape[1]
    same = np.zeros(width, np.int32)  # equal labels in a column, up to this row
    for last in range(len(tall)):
        line, above = tall[last], tall[max(last - 1, 0)]
        for column in range(width):
            same[column] = same[column] + 1 if line[column] == above[column] else 1
        row = last - 2 * down
        if row < 0:
            continue
        # Another label is close if the labels above and below a close pixel, or two neighbors
        # along the parallel, are not the same.
        middle, reach, marked = tall[last - down], across[row], -width
        for column in range(width):
            is_mixed = same[column] <= 2 * down
            if is_mixed or middle[column] != middle[column + 1 if column + 1 < width else 0]:
                for place in range(
                    max(marked, column - reach + (not is_mixed)), column + reach + 1
                ):
                    near[row, place - width if place >= width else place] = True
                marked = column + reach + 1


@lru_cache(maxsize=4)
def _reach(height: int, width: int) -> tuple[int, NDArray[np.intp]]:
    """Return the rows, and the columns in each row, within `BOUNDARY_DEG`."""
    down = max(1, round(BOUNDARY_DEG * height / 180))
    latitudes = math.pi / 2 - (2 * np.arange(height) + 1) * math.pi / (2 * height)
    across = np.rint(BOUNDARY_DEG * width / 360 / np.cos(latitudes))
    return down, across.clip(1, width // 2).astype(np.intp)


@njit_exact
def count_rows(
    maps: tuple[Array, Array, Array, Array], beside: int, pairs: Array, edges: Array, changes: Array
) -> None:
    """Count the pixels of each of n rows of a panorama; add them to the counts.

    Args:
        maps: ``(n, W)`` predicted and true labels, and `near_boundary` of both. Unknown pixels, of
            true label 0, are not counted.
        beside: Columns on each side of the seam that are beside it.
        pairs: ``(2, n, K+1, K+1)`` pixels by true and predicted label; those beside the seam.
        edges: ``(3, n, K+1)`` pixels near boundaries, by true and by predicted label; those of
            equal labels near both boundaries.
        changes: ``(6, n)`` unequal predicted and true neighbors, and all, across the seam; others.
    """
    predicted, true, near_predicted, near_true = maps
    rows, width = true.shape
    for row in range(rows):
        for column in range(width):
            p, t = predicted[row, column], true[row, column]
            if t == 0:
                continue
            pairs[0, row, t, p] += 1
            if column < beside or column >= width - beside:
                pairs[1, row, t, p] += 1
            is_near, is_true = near_predicted[row, column], near_true[row, column]
            edges[0, row, t] += is_true
            edges[1, row, p] += is_near
            edges[2, row, t] += is_true and is_near and t == p
            first, right = (3, column + 1) if column + 1 < width else (0, 0)
            if true[row, right] > 0:
                changes[first, row] += p != predicted[row, right]
                changes[first + 1, row] += t != true[row, right]
                changes[first + 2, row] += 1
