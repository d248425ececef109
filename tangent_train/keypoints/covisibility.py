"""Covisibility of two panoramas, from depth and poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import (
    PanoramaPose,
    equirect_to_lonlat,
    lonlat_to_equirect,
    lonlat_to_xyz,
    xyz_to_lonlat,
)
from tangent_train.geometry.sphere import Floats
from tangent_train.keypoints.features import angles_between

_TOLERANCE, _TOLERANCE_M = 0.03, 0.03
"""Occlusion tolerance behind a surface: share of the distance, and meters."""

_SMOOTH = 1.1
"""Distances of neighboring pixels of one surface rarely differ by more than this factor."""

_ROWS = 512
"""Rows of a panorama on which the overlap is sampled."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """Ground-truth depth and pose of a panorama.

    Args:
        distance_m: ``(H, W)`` distances from the center in meters, NaN where missing. The
            resolution may differ from the panorama's.
        pose: Pose of the panorama.
    """

    distance_m: NDArray[np.floating]
    pose: PanoramaPose

    def distances(self, directions_xyz: Floats) -> tuple[Floats, Floats]:
        """Return distances in directions.

        Between four pixels of one surface 1/d is interpolated, which is linear in the direction on
        a plane. At depth edges the distance is that of the nearest pixel with a distance; its
        surface may continue towards the next pixel, farther away.

        Args:
            directions_xyz: ``(n, 3)`` unit vectors.

        Returns:
            ``(n,)`` distances in meters, and ``(n,)`` upper bounds for the same surface; NaN where
            all four pixels are missing.
        """
        height, width = self.distance_m.shape
        u, v = lonlat_to_equirect(xyz_to_lonlat(directions_xyz), (height, width)).T
        rows = np.floor(v) + np.array([[0], [0], [1], [1]])
        inside = rows.clip(0, height - 1)
        # Beyond a pole the row reflects, rotated by half a revolution.
        u = np.where(inside == rows, u, u + width / 2)
        columns = np.floor(u) + np.array([[0], [1], [0], [1]])
        weight = (1 - np.abs(rows - v)) * (1 - np.abs(columns - u))
        index = (inside * width + columns % width).astype(np.int64)
        four = self.distance_m.reshape(-1)[index].astype(np.float64)
        touched = weight > 1e-6  # rounding may include pixels without weight
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
    """Return a mask of directions in one panorama whose points are visible in another.

    A panorama has no borders: a point is visible unless a surface in the target is nearer than the
    point by more than 3 % and 3 cm. Directions without a distance are not visible. Where the target
    has no distance, points count as visible.

    Args:
        directions_xyz: ``(n, 3)`` unit vectors in the source.
        source: Panorama of the directions.
        target: Panorama in which the points may be visible.

    Returns:
        ``(n,)`` bool.
    """
    distance_m, _ = source.distances(directions_xyz)
    placed = ~np.isnan(distance_m)
    points_m = source.pose.points_m(directions_xyz, np.where(placed, distance_m, 1.0))
    target_xyz, away_m = target.pose.project(points_m)
    _, reach_m = target.distances(target_xyz)
    # A comparison with NaN is False: missing distances do not occlude.
    return placed & ~(away_m > reach_m + _TOLERANCE_M + _TOLERANCE * away_m)


def fov_overlap(left: DepthView, right: DepthView) -> float:
    """Return the overlap of fields of view (paper, section "Sparse keypoint correspondences").

    It is the mean of two shares: points of the right panorama that are visible in the left one, and
    vice versa. Points are pixels with a distance; as in the paper, the poles are over-counted.

    Args:
        left: Left panorama.
        right: Right panorama.

    Returns:
        0 to 1; NaN if one of the two has no distances.
    """
    return (_seen_share(left, right) + _seen_share(right, left)) / 2


def _seen_share(source: DepthView, target: DepthView) -> float:
    height, width = source.distance_m.shape
    across, down = max(1, round(width / _ROWS / 2)), max(1, round(height / _ROWS))
    rows, columns = np.mgrid[down // 2 : height : down, across // 2 : width : across]
    there = ~np.isnan(source.distance_m[rows, columns])
    if not there.any():
        return math.nan
    pixels = np.stack([columns, rows], axis=-1)[there]
    directions = lonlat_to_xyz(equirect_to_lonlat(pixels, (height, width)))
    return float(visible_from(directions, source, target).mean())


def correct_matches(
    left_xyz: Floats,
    right_xyz: Floats,
    left: DepthView,
    right: DepthView,
    max_error_deg: float = 1.0,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Verify matches by depth and pose, independently of estimated geometry.

    The left point is placed at its distance and projected into the right panorama, and vice versa.
    A match is correct if one of the two is within `max_error_deg` of its partner. One is enough,
    because keypoints are often at depth edges, where the other distance may belong to the
    background.

    Args:
        left_xyz: ``(m, 3)`` unit vectors in the left panorama.
        right_xyz: ``(m, 3)`` unit vectors in the right panorama.
        left: Depth and pose of the left panorama.
        right: Depth and pose of the right panorama.
        max_error_deg: Largest angle of a correct match.

    Returns:
        ``(m,)`` correct matches, and ``(m,)`` matches for which at least one panorama has a
        distance.
    """
    there = _transfer_errors_deg(left_xyz, right_xyz, left, right)
    back = _transfer_errors_deg(right_xyz, left_xyz, right, left)
    correct = (there <= max_error_deg) | (back <= max_error_deg)
    return correct, ~(np.isnan(there) & np.isnan(back))


def _transfer_errors_deg(
    source_xyz: Floats, target_xyz: Floats, source: DepthView, target: DepthView
) -> Floats:
    """Return angles between the source's points, projected into the target, and their matches."""
    distance_m, _ = source.distances(source_xyz)
    projected_xyz, _ = target.pose.project(source.pose.points_m(source_xyz, distance_m))
    return np.degrees(angles_between(projected_xyz, target_xyz))
