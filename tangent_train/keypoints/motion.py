"""Motion between two panoramas: epipolar arcs, and the significance of a fit.

A point in direction l of the left panorama lies on a ray at an unknown distance. In the right
panorama, with ``x_right = R x_left + t``, the ray appears as a great-circle arc. It starts at
``R l``, the ray's point at infinity, and ends at ``t``, the left center. Without translation the
arc is the point ``R l``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tangent_train.keypoints.spherical import Floats, angles_between

_SHIFTS = 16
_PRECISION_RAD = math.radians(0.01)
"""Lower limit for σ, below the precision of keypoints."""


class Motion(NamedTuple):
    """Motion from left to right coordinates, ``x_right = R x_left + t``.

    Attributes:
        rotation: ``(3, 3)`` R.
        translation: ``(3,)`` t of length 1; None if both panoramas have the same center.
    """

    rotation: Floats
    translation: Floats | None = None

    @property
    def sample(self) -> int:
        """Number of matches that determine a motion (minimal sample)."""
        return 2 if self.translation is None else 5


def motion_errors(left_xyz: Floats, right_xyz: Floats, motion: Motion) -> Floats:
    """Return the angular error of matches under a motion.

    Args:
        left_xyz: ``(m, 3)`` unit vectors.
        right_xyz: ``(m, 3)`` unit vectors.
        motion: The motion.

    Returns:
        ``(m,)`` radians: the larger of the angle between the right direction and the arc of the
        left one, and the angle between the left direction and the arc of the right one.
    """
    rotation, translation = motion
    ahead = left_xyz @ rotation.T
    if translation is None:
        return angles_between(ahead, right_xyz)
    return np.maximum(
        _arc_angles(right_xyz, ahead, translation), _arc_angles(ahead, right_xyz, -translation)
    )


def _arc_angles(points_xyz: Floats, starts_xyz: Floats, end_xyz: Floats) -> Floats:
    """Return angles between points and the shorter arcs from ``(m, 3)`` starts to one end."""
    normals = np.cross(starts_xyz, end_xyz)
    sines = np.linalg.norm(normals, axis=1)
    across = np.abs((points_xyz * normals).sum(axis=1)) / np.maximum(sines, 1e-300)
    # A point is nearest to the inside of the arc, or to one of its ends.
    after_start = (points_xyz * np.cross(normals, starts_xyz)).sum(axis=1) >= 0
    before_end = (points_xyz * np.cross(end_xyz, normals)).sum(axis=1) >= 0
    ends = np.minimum(angles_between(points_xyz, starts_xyz), angles_between(points_xyz, end_xyz))
    beside = after_start & before_end & (sines > 0)
    return np.where(beside, np.arcsin(np.minimum(across, 1.0)), ends)


def is_by_chance(left_xyz: Floats, right_xyz: Floats, motion: Motion, max_error_rad: float) -> bool:
    """Return True if a motion with as many inliers is expected by chance.

    The expected number of such motions is ``(m − s) · C(m, k) · C(k, s) · pᵏ⁻ˢ`` (Moisan and Stival
    2004, equation 6; the criterion of OpenMVG, which the paper used). It has m matches, k inliers,
    the sample size s, and the share p of wrong matches that fit the motion. A motion is significant
    if the number is below 1. p is measured on directions that were not matched with each other, so
    that it takes the density of keypoints into account.

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
    """Return True if a rotation explains the matches, by Torr's criterion GRIC (1998).

    ``Σ min(e²/σ², 2 (4 − d)) + n d ln 4 + k ln 4n`` is compared, over the matches that fit one of
    the two: d = 3, k = 5 for a general motion, d = 2, k = 3 for a rotation. The smaller value wins.
    σ is estimated from the median of the general motion's errors.

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
