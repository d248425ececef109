"""Bring the distances of several panoramas to one scale.

Frames of a video are near each other: in most directions, the distance hardly changes from one to
the next, so the median of its change is the change of the scale.

With known poses, points of a panorama at the distances ``s_a d_a`` are seen from another position
at distances that should be ``s_b d_b``. The logarithms of the scales s minimize the Cauchy loss of
the differences of the logarithms of these distances, over all pairs at once; surfaces that only one
of two panoramas sees are outliers. Parallax determines the unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import (
    PanoramaPose,
    icosphere,
    lonlat_to_equirect,
    lonlat_to_xyz,
    xyz_to_lonlat,
)
from tangent_train.geometry.sphere import Floats
from tangent_train.heads.alignment import matrix_rows, robust_fit

_DIRECTIONS = lonlat_to_xyz(xyz_to_lonlat(icosphere(4).vertices))
_COMMON = np.linspace(-3, 3, 25)
"""Logarithms of common scales of all panoramas that are tried as a start."""
_MOST_STEP = 0.8
"""Step with parallax, divided by the step without it, above which nothing determines the unit."""
_FAR = 12.0
"""Logarithm of a scale at which there is no parallax."""
_LEAST_POINTS = 30
"""Points below which a median is not taken: with errors of 20 %, its error is about 5 %."""
_NEIGHBORS = 4
"""Nearest panoramas with which one is compared."""

Scales = tuple[Floats, tuple[float, float]]
"""Scales ``(n,)``; and the median absolute difference of the logarithms of the distances of two
panoramas, before and after."""


def frame_scales(distances: NDArray[np.floating]) -> Scales:
    """Return the scales of frames, each near the next one and not rotated; their median is 1.

    Args:
        distances: ``(n, H, W)`` distances from the centers, 0 or NaN where unknown; small images
            suffice.
    """
    numbers = np.arange(len(distances))[:, None]
    steps = np.diff(np.log(_at(distances, numbers, _DIRECTIONS[None])), axis=0)
    logs = -np.append(0, np.cumsum(np.nanmedian(steps, axis=1)))
    after = steps + np.diff(logs)[:, None]
    logs -= np.median(logs)
    return np.exp(logs), (np.nanmedian(np.abs(steps)), np.nanmedian(np.abs(after)))


def pose_scales(
    distances: NDArray[np.floating],
    poses: Sequence[PanoramaPose],
    points: Sequence[Floats] = (),
) -> Scales:
    """Return the scales of panoramas in the unit of their poses; NaN where nothing determines them.

    Args:
        distances: See `frame_scales`.
        poses: Poses of the panoramas.
        points: Points ``(m, 3)`` that each panorama sees, of which some may be wrong. If there are
            any, they determine the scales, instead of the parallax.
    """
    if any(map(len, points)):
        return _point_scales(distances, poses, points)
    count, numbers = len(distances), np.arange(len(distances))
    centers = np.stack([pose.location_m for pose in poses])
    axes = np.stack([pose.world_from_panorama for pose in poses])
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1) + np.diag(np.full(count, np.inf))
    near = np.argsort(apart, axis=1)[:, : min(_NEIGHBORS, count - 1)]
    first, second = np.repeat(numbers, near.shape[1]), near.ravel()
    seen = _DIRECTIONS * _at(distances, numbers[:, None], _DIRECTIONS[None])[..., None]

    def compare(logs: Floats) -> tuple[Floats, Any]:
        away = np.exp(logs[first])[:, None, None] * seen[first] @ axes[first].swapaxes(1, 2)
        offset = away + (centers[first] - centers[second])[:, None]
        far = np.linalg.norm(offset, axis=-1)
        found = _at(distances, second[:, None], offset @ axes[second])
        residual = logs[second, None] + np.log(found / far)
        # The derivative of ln far; the change of the direction is left out.
        slope = (away * offset).sum(axis=-1) / far**2
        known = np.isfinite(residual)
        columns = [np.broadcast_to(index[:, None], known.shape)[known] for index in (first, second)]
        entries = [-slope[known], np.ones(known.sum())]
        return residual[known], matrix_rows(entries, columns, count)

    def step(logs: Floats) -> float:
        return float(np.median(np.abs(compare(logs)[0])))

    start = np.zeros(count)
    logs = robust_fit(lambda logs: compare(logs + _FAR), start)
    logs = logs - np.median(logs)
    logs = robust_fit(compare, logs + min(_COMMON, key=lambda common: step(logs + common)))
    steps = step(start), step(logs)
    if steps[1] > _MOST_STEP * step(logs - np.median(logs) + _FAR):
        logs = np.full(count, np.nan)
    return np.exp(logs), steps


def _point_scales(
    distances: NDArray[np.floating], poses: Sequence[PanoramaPose], points: Sequence[Floats]
) -> Scales:
    """Return the medians of the quotients of the distances of points and of the panoramas."""
    logs, steps = np.full(len(poses), np.nan), []
    for number, (pose, of_model) in enumerate(zip(poses, points, strict=True)):
        directions, far = pose.project(of_model)
        found = np.log(far / _at(distances, number, directions))
        found = found[np.isfinite(found)]
        if len(found) >= _LEAST_POINTS:
            logs[number] = np.median(found)
            steps.append(np.abs([found, found - logs[number]]))
    before, after = np.median(np.hstack(steps), axis=1) if steps else (np.nan, np.nan)
    return np.exp(logs), (before, after)


def _at(distances: NDArray[np.floating], images: Any, directions: Floats) -> Floats:
    """Return the distances in directions ``(…, 3)``, of the nearest pixels; NaN where unknown."""
    height, width = distances.shape[1:]
    place = np.nan_to_num(lonlat_to_equirect(xyz_to_lonlat(directions), (height, width)))
    columns, rows = np.moveaxis(np.rint(place).astype(np.intp), -1, 0)
    found = distances[images, rows.clip(0, height - 1), columns % width]
    return np.where(found > 0, found, np.nan).astype(np.float64)
