"""What two panoramas see of each other's surroundings, from depth and poses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    equirect_solid_angles,
    equirect_to_lonlat,
    lonlat_to_xyz,
)
from tangent_train.keypoints.depth_view import DepthView
from tangent_train.keypoints.spherical import angles_between, unit_directions

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = [
    "DepthView",
    "MatchTruth",
    "Tolerance",
    "Visibility",
    "correct_matches",
    "fov_overlap",
    "visible_count",
    "visible_from",
]

_BLOCK = 2**17
"""Directions looked at together."""


class Tolerance(NamedTuple):
    """How far behind what a panorama sees a point may be and still count as seen.

    Attributes:
        relative: Share of the point's distance.
        absolute_m: Metres on top.
    """

    relative: float = 0.03
    absolute_m: float = 0.03


_TOLERANCE = Tolerance()


class Visibility(NamedTuple):
    """Which directions of one panorama another one should see.

    Attributes:
        visible: ``(n,)`` bool. A direction without distance does not count as visible: it cannot
            be placed. Where the other panorama has no distance nothing is known to hide the point,
            and it counts as visible.
        known: ``(n,)`` bool, both distances are there.
    """

    visible: NDArray[np.bool_]
    known: NDArray[np.bool_]


def visible_from(
    directions_xyz: ArrayLike,
    source: DepthView,
    target: DepthView,
    tolerance: Tolerance = _TOLERANCE,
) -> Visibility:
    """Which of a panorama's directions show what another panorama sees, too.

    A panorama has no borders, so only what is in between hides a point: it is visible unless the
    target's distance in its direction is shorter than its own, by more than the tolerance.

    Args:
        directions_xyz: ``(n, 3)`` directions in the source.
        source: The panorama they belong to.
        target: The one that should see them.
        tolerance: How much farther a point may be than what the target sees.

    Raises:
        SettingError: The directions are none.
    """
    directions = unit_directions(directions_xyz)
    visible, known = np.zeros((2, len(directions)), np.bool_)
    for start in range(0, len(directions), _BLOCK):
        part = slice(start, start + _BLOCK)
        distance_m, _ = source.distances(directions[part])
        points_m = source.pose.points_m(directions[part], distance_m)
        placed = ~np.isnan(distance_m)
        seen_xyz, away_m = target.pose.seen(np.where(placed[:, None], points_m, 0.0))
        _, reach_m = target.distances(seen_xyz)
        limit_m = reach_m + tolerance.absolute_m + tolerance.relative * away_m
        visible[part] = placed & ~(away_m > limit_m)  # NaN hides nothing
        known[part] = placed & ~np.isnan(reach_m)
    return Visibility(visible, known)


def visible_count(
    directions_xyz: ArrayLike,
    source: DepthView,
    target: DepthView,
    tolerance: Tolerance = _TOLERANCE,
) -> int:
    """How many keypoints of the source the target should see: the paper's n_L and n_R.

    Args:
        directions_xyz: ``(n, 3)`` keypoints of the source.
        source: Their panorama.
        target: The other panorama.
        tolerance: See `visible_from`.
    """
    return int(visible_from(directions_xyz, source, target, tolerance).visible.sum())


def fov_overlap(
    left: DepthView,
    right: DepthView,
    tolerance: Tolerance = _TOLERANCE,
    *,
    rows: int = 512,
    by_solid_angle: bool = False,
) -> float:
    """Overlap of the fields of view (paper, section "Sparse keypoint correspondences").

    The mean of two shares: of the right panorama's points those the left camera sees, and vice
    versa. Points are pixels that have a distance. Like the paper's, which over-count the poles,
    unless they are weighted.

    Args:
        left: One panorama.
        right: The other.
        tolerance: See `visible_from`.
        rows: Of larger panoramas about that many rows and twice as many columns are counted,
            evenly spread.
        by_solid_angle: Weigh every pixel by its solid angle.

    Returns:
        0 to 1, NaN where one of the two has no distances.
    """
    shares = (
        _seen_share(source, target, tolerance, rows, by_solid_angle)
        for source, target in ((left, right), (right, left))
    )
    return math.fsum(shares) / 2


def _seen_share(
    source: DepthView, target: DepthView, tolerance: Tolerance, rows: int, by_solid_angle: bool
) -> float:
    height, width = source.distance_m.shape
    chosen_rows, chosen_columns = (
        np.arange(step // 2, size, step)
        for size, step in (
            (height, max(1, round(height / rows))),
            (width, max(1, round(width / (2 * rows)))),
        )
    )
    there = ~np.isnan(source.distance_m[np.ix_(chosen_rows, chosen_columns)])
    if not there.any():
        return math.nan
    pixels = np.stack(np.meshgrid(chosen_columns, chosen_rows), axis=-1)[there]
    directions = lonlat_to_xyz(equirect_to_lonlat(pixels, (height, width)))
    visible = visible_from(directions, source, target, tolerance).visible
    areas = equirect_solid_angles((height, width))[pixels[:, 1]]
    return float(np.average(visible, weights=areas if by_solid_angle else None))


class MatchTruth(NamedTuple):
    """Which matches show the same point of the room.

    Attributes:
        correct: ``(m,)`` bool.
        known: ``(m,)`` bool, a distance is there in one of the two panoramas.
    """

    correct: NDArray[np.bool_]
    known: NDArray[np.bool_]


def correct_matches(
    left_xyz: ArrayLike,
    right_xyz: ArrayLike,
    left: DepthView,
    right: DepthView,
    max_error_deg: float = 1.0,
) -> MatchTruth:
    """Judge matches by depth and pose instead of by the geometry estimated from them.

    The left point is placed at its distance and seen from the right, and the other way round; the
    match is correct where one of the two ends within `max_error_deg` of its partner. One is enough:
    keypoints are often at edges of depth, where the other distance may be the background's.

    Args:
        left_xyz: ``(m, 3)`` directions in the left panorama.
        right_xyz: ``(m, 3)`` directions in the right one.
        left: The left panorama.
        right: The right one.
        max_error_deg: Largest angle.

    Raises:
        SettingError: The directions are none or do not belong together.
    """
    rays = unit_directions(left_xyz), unit_directions(right_xyz)
    if len(rays[0]) != len(rays[1]):
        raise SettingError(
            "matched directions",
            found=f"{len(rays[0])} and {len(rays[1])}",
            expected="as many left ones as right ones",
        )
    there = _transfer_errors_deg(rays[0], rays[1], left, right)
    back = _transfer_errors_deg(rays[1], rays[0], right, left)
    correct = (there <= max_error_deg) | (back <= max_error_deg)
    return MatchTruth(correct, ~(np.isnan(there) & np.isnan(back)))


def _transfer_errors_deg(
    source_xyz: NDArray[np.float64],
    target_xyz: NDArray[np.float64],
    source: DepthView,
    target: DepthView,
) -> NDArray[np.float64]:
    """Angles between where the target sees the source's points and where it should."""
    distance_m, _ = source.distances(source_xyz)
    seen_xyz, _ = target.pose.seen(source.pose.points_m(source_xyz, distance_m))
    return np.degrees(angles_between(seen_xyz, target_xyz))
