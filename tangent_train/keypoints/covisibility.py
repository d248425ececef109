"""Covisibility of two panoramas, from depth and poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from tangent_train.geometry import (
    PanoramaPose,
    equirect_to_lonlat,
    lonlat_to_equirect,
    lonlat_to_xyz,
    xyz_to_lonlat,
)
from tangent_train.keypoints.spherical import Floats, angles_between
from tangent_train.rendering.sampling import bilinear_equirect_taps

_TOLERANCE, _TOLERANCE_M = 0.03, 0.03
"""Occlusion tolerance behind a surface: share of the distance, and meters."""

_SMOOTH = 1.1
"""Distances of neighboring pixels of one surface rarely differ by more than this factor."""

_ROWS = 512
"""Rows of a panorama on which the overlap is sampled."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """Depth and pose of a panorama, as known of its room.

    Args:
        distance_m: ``(H, W)`` distances from the center in meters, of any resolution; NaN where
            missing.
        pose: Camera pose.
    """

    distance_m: NDArray[np.floating]
    pose: PanoramaPose

    def distances(self, directions_xyz: Floats) -> tuple[Floats, Floats]:
        """Distances in directions.

        Between four pixels of one surface 1/d is interpolated, which is linear in the direction on
        a plane. At depth edges the distance is that of the nearest pixel that has one; its surface
        may go on towards the next pixel, farther away.

        Args:
            directions_xyz: ``(n, 3)``.

        Returns:
            ``(n,)`` distances in meters, and ``(n,)`` how far the same surface may be; NaN where
            all four pixels are missing.
        """
        height, width = self.distance_m.shape
        pixels = lonlat_to_equirect(xyz_to_lonlat(directions_xyz), (height, width))
        u, v = torch.from_numpy(pixels).unbind(-1)
        taps = bilinear_equirect_taps(u, v, (height, width))
        weight = taps.weight.numpy()
        four = self.distance_m.reshape(-1)[taps.source.numpy()].astype(np.float64)
        touched = weight > 1e-6  # others are among the four by rounding only
        there = touched & ~np.isnan(four)
        farthest = np.where(there, four, -np.inf).max(axis=0)
        closest = np.where(there, four, np.inf).min(axis=0)
        nearest = np.where(there, weight, -np.inf).argmax(axis=0)
        distance = np.take_along_axis(four, nearest[None], axis=0)[0]
        smooth = (there == touched).all(axis=0) & (farthest <= _SMOOTH * closest)
        distance[smooth] = 1 / np.where(there, weight / four, 0.0).sum(axis=0)[smooth]
        distance[~there.any(axis=0)] = np.nan
        return distance, distance * np.where(smooth, 1.0, _SMOOTH)


def visible_from(directions_xyz: Floats, source: DepthView, target: DepthView) -> NDArray[np.bool_]:
    """Mask of the directions of one panorama whose points are visible in another.

    A panorama has no borders: a point is visible unless the target's distance in its direction is
    shorter than its own by more than 3 % and 3 cm. A direction without distance cannot be placed
    and does not count; where the target has no distance nothing is known to occlude the point.

    Args:
        directions_xyz: ``(n, 3)`` unit vectors in the source.
        source: The panorama they belong to.
        target: The one that may see them.

    Returns:
        ``(n,)`` bool.
    """
    distance_m, _ = source.distances(directions_xyz)
    placed = ~np.isnan(distance_m)
    points_m = source.pose.points_m(directions_xyz, np.where(placed, distance_m, 1.0))
    seen_xyz, away_m = target.pose.seen(points_m)
    _, reach_m = target.distances(seen_xyz)
    return placed & ~(away_m > reach_m + _TOLERANCE_M + _TOLERANCE * away_m)  # NaN hides nothing


def fov_overlap(left: DepthView, right: DepthView) -> float:
    """Overlap of the fields of view (paper, section "Sparse keypoint correspondences").

    The mean of two shares: of the right panorama's points, those that the left camera sees, and
    vice versa. Points are pixels that have a distance; like the paper's share, this over-counts
    the poles.

    Returns:
        0 to 1; NaN where one of the two has no distances.
    """
    return (_seen_share(left, right) + _seen_share(right, left)) / 2


def _seen_share(source: DepthView, target: DepthView) -> float:
    height, width = source.distance_m.shape
    across, down = (
        max(1, round(size / most)) for size, most in ((width, 2 * _ROWS), (height, _ROWS))
    )
    rows, columns = np.mgrid[down // 2 : height : down, across // 2 : width : across]
    there = ~np.isnan(source.distance_m[rows, columns])
    if not there.any():
        return math.nan
    pixels = np.stack([columns, rows], axis=-1)[there]
    directions = lonlat_to_xyz(equirect_to_lonlat(pixels, (height, width)))
    return float(visible_from(directions, source, target).mean())


class MatchTruth(NamedTuple):
    """Matches verified against depth and pose.

    Attributes:
        correct: ``(m,)`` bool.
        known: ``(m,)`` bool, one of the two panoramas has a distance.
    """

    correct: NDArray[np.bool_]
    known: NDArray[np.bool_]


def correct_matches(
    left_xyz: Floats,
    right_xyz: Floats,
    left: DepthView,
    right: DepthView,
    max_error_deg: float = 1.0,
) -> MatchTruth:
    """Verify matches by depth and pose, independently of any estimated geometry.

    The left point is placed at its distance and seen from the right, and vice versa; the match is
    correct where one of the two ends within `max_error_deg` of its partner. One is enough:
    keypoints are often at depth edges, where the other distance may be that of the background.

    Args:
        left_xyz: ``(m, 3)`` unit vectors in the left panorama.
        right_xyz: ``(m, 3)`` unit vectors in the right one.
        left: The left panorama.
        right: The right one.
        max_error_deg: Largest angle.
    """
    there = _transfer_errors_deg(left_xyz, right_xyz, left, right)
    back = _transfer_errors_deg(right_xyz, left_xyz, right, left)
    correct = (there <= max_error_deg) | (back <= max_error_deg)
    return MatchTruth(correct, ~(np.isnan(there) & np.isnan(back)))


def _transfer_errors_deg(
    source_xyz: Floats, target_xyz: Floats, source: DepthView, target: DepthView
) -> Floats:
    """Angles between where the target sees the source's points and where it should."""
    distance_m, _ = source.distances(source_xyz)
    seen_xyz, _ = target.pose.seen(source.pose.points_m(source_xyz, distance_m))
    return np.degrees(angles_between(seen_xyz, target_xyz))
