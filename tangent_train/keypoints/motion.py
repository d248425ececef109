"""Motion between two panoramas: its epipolar arcs, and the significance of a fit.

A point in direction l of the left panorama lies somewhere on a ray. In the right panorama, with
``x_right = R x_left + t``, the ray appears as the great-circle arc from ``R l``, its point at
infinity, to ``t``, the left center. Without translation the arc is the point ``R l``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tangent_train.keypoints.spherical import Floats, angles_between

_SHIFTS = 16
_PRECISION_RAD = math.radians(0.01)
"""Below the precision of any keypoint."""


class Motion(NamedTuple):
    """From left to right coordinates: ``x_right = R x_left + t``.

    Attributes:
        rotation: ``(3, 3)`` R.
        translation: ``(3,)`` t of length 1; None if both were taken at one place.
    """

    rotation: Floats
    translation: Floats | None = None

    @property
    def sample(self) -> int:
        """Size of a minimal sample of matches, which some motion always fits."""
        return 2 if self.translation is None else 5


def motion_errors(left_xyz: Floats, right_xyz: Floats, motion: Motion) -> Floats:
    """Angular error of matches under a motion.

    Args:
        left_xyz: ``(m, 3)`` unit vectors.
        right_xyz: ``(m, 3)`` unit vectors.
        motion: The motion.

    Returns:
        ``(m,)`` radians: the angle between the right direction and the arc of the left one, or
        between the left one and the arc of the right one, whichever is larger.
    """
    rotation, translation = motion
    ahead = left_xyz @ rotation.T
    if translation is None:
        return angles_between(ahead, right_xyz)
    return np.maximum(
        _arc_angles(right_xyz, ahead, translation), _arc_angles(ahead, right_xyz, -translation)
    )


def _arc_angles(points_xyz: Floats, starts_xyz: Floats, end_xyz: Floats) -> Floats:
    """Angles between points and the shorter arcs from ``(m, 3)`` starts to one end."""
    normals = np.cross(starts_xyz, end_xyz)
    sines = np.linalg.norm(normals, axis=1)
    across = np.abs((points_xyz * normals).sum(axis=1)) / np.maximum(sines, 1e-300)
    # Beside the arc are points between its ends, seen along it; others are nearest to an end.
    after_start = (points_xyz * np.cross(normals, starts_xyz)).sum(axis=1) >= 0
    before_end = (points_xyz * np.cross(end_xyz, normals)).sum(axis=1) >= 0
    ends = np.minimum(angles_between(points_xyz, starts_xyz), angles_between(points_xyz, end_xyz))
    beside = after_start & before_end & (sines > 0)
    return np.where(beside, np.arcsin(np.minimum(across, 1.0)), ends)


def is_by_chance(left_xyz: Floats, right_xyz: Floats, motion: Motion, max_error_rad: float) -> bool:
    """True if a motion would fit as many matches by chance.

    The expected number of such motions is ``(m − s) · C(m, k) · C(k, s) · pᵏ⁻ˢ`` (Moisan and Stival
    2004, equation 6; the criterion of OpenMVG, which the paper used) with m matches, k inliers, the
    sample size s, and the share p of wrong matches that fit; a motion counts if it is below 1. p is
    measured on directions that were not matched with each other, so that it accounts for where
    keypoints are dense.

    Args:
        left_xyz: ``(m, 3)`` unit vectors.
        right_xyz: ``(m, 3)`` unit vectors.
        motion: The motion.
        max_error_rad: Largest error of an inlier.
    """
    m, s = len(left_xyz), motion.sample
    k = int((motion_errors(left_xyz, right_xyz, motion) <= max_error_rad).sum())
    if k <= s:
        return True
    shifts = np.unique(np.linspace(1, m - 1, _SHIFTS).astype(np.int64))
    wrong = [motion_errors(left_xyz, np.roll(right_xyz, n, axis=0), motion) for n in shifts]
    share = max(float(np.mean(np.array(wrong) <= max_error_rad)), math.sin(max_error_rad / 2) ** 2)
    choices = math.log(m - s) + _log_choices(m, k) + _log_choices(k, s)
    return choices + (k - s) * math.log(share) > 0


def _log_choices(of: int, chosen: int) -> float:
    return math.lgamma(of + 1) - math.lgamma(chosen + 1) - math.lgamma(of - chosen + 1)


def prefers_rotation(general_errors: Floats, rotation_errors: Floats, max_error_rad: float) -> bool:
    """True if a rotation alone explains the matches: Torr's GRIC (1998).

    ``Σ min(e²/σ², 2 (4 − d)) + n d ln 4 + k ln 4n`` with d = 3, k = 5 for a general motion and
    d = 2, k = 3 for a rotation, over the matches that one of the two allows; the smaller wins. σ
    is that of the general motion, from the median of its errors.

    Args:
        general_errors: ``(m,)`` radians.
        rotation_errors: ``(m,)`` radians.
        max_error_rad: Largest error of an inlier.
    """
    fits = general_errors <= max_error_rad
    if not fits.any():
        return True
    sigma = max(1.4826 * float(np.median(general_errors[fits])), _PRECISION_RAD)
    either = fits | (rotation_errors <= max_error_rad)

    def cost(errors: Floats, dimension: int, freedom: int) -> float:
        count = int(either.sum())
        misfit = np.minimum((errors[either] / sigma) ** 2, 2 * (4 - dimension)).sum()
        return float(misfit + count * dimension * math.log(4) + freedom * math.log(4 * count))

    return cost(rotation_errors, 2, 3) < cost(general_errors, 3, 5)
