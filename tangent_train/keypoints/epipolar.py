"""Two panoramas of one scene: where a match may lie, and how sure it is that it does.

A point in direction l of the left panorama is somewhere on a ray. Turned into the right panorama by
R and moved by t (``x_right = R x_left + t``) the ray appears as the arc of a great circle from
``R l``, its point at infinity, to ``t``, the left centre. Where the panoramas were taken at one
place the arc is the point ``R l``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tangent_train.keypoints.spherical import angles_between

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Motion", "chance_share", "log_false_alarms", "motion_errors", "prefers_rotation"]

_SHIFTS = 16


class Motion(NamedTuple):
    """From left to right coordinates: ``x_right = R x_left + t``.

    Attributes:
        rotation: ``(3, 3)`` R.
        translation: ``(3,)`` t of length 1, or None: the two were taken at one place.
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64] | None

    @property
    def sample(self) -> int:
        """Matches that any motion can be made to fit."""
        return 2 if self.translation is None else 5


def motion_errors(
    left_xyz: NDArray[np.float64], right_xyz: NDArray[np.float64], motion: Motion
) -> NDArray[np.float64]:
    """How far matches are from where a motion allows them to be.

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
        _arc_angles(right_xyz, ahead, translation),
        _arc_angles(ahead, right_xyz, -translation),
    )


def _arc_angles(
    points_xyz: NDArray[np.float64], starts_xyz: NDArray[np.float64], end_xyz: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Angles between points and the shorter arcs from ``(m, 3)`` starts to one end."""
    normals = np.cross(starts_xyz, end_xyz)
    sines = np.linalg.norm(normals, axis=1)
    across = np.abs(_dots(points_xyz, normals)) / np.maximum(sines, 1e-300)
    # Beside the arc are points between its ends, seen along it; others are nearest to an end.
    after_start = _dots(points_xyz, np.cross(normals, starts_xyz)) >= 0
    before_end = _dots(points_xyz, np.cross(end_xyz, normals)) >= 0
    ends = np.minimum(angles_between(points_xyz, starts_xyz), angles_between(points_xyz, end_xyz))
    return np.where(
        after_start & before_end & (sines > 0), np.arcsin(np.minimum(across, 1.0)), ends
    )


def _dots(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.einsum("mc,mc->m", first, second)


def chance_share(
    left_xyz: NDArray[np.float64],
    right_xyz: NDArray[np.float64],
    motion: Motion,
    max_error_rad: float,
) -> float:
    """Share of wrong matches that a motion allows by chance.

    Measured on pairs of left and right directions that were not matched with each other, so that
    it knows where keypoints are dense. At least the share of the sphere in reach of a point.

    Args:
        left_xyz: ``(m, 3)`` unit vectors.
        right_xyz: ``(m, 3)`` unit vectors.
        motion: The motion.
        max_error_rad: How far from it matches may be.
    """
    count = len(left_xyz)
    least = math.sin(max_error_rad / 2) ** 2
    if count < 2:
        return least
    shares = [
        np.mean(motion_errors(left_xyz, np.roll(right_xyz, shift, axis=0), motion) <= max_error_rad)
        for shift in np.unique(np.linspace(1, count - 1, _SHIFTS).astype(np.int64))
    ]
    return max(float(np.mean(shares)), least)


def log_false_alarms(matches: int, inliers: int, sample: int, share: float) -> float:
    """Expected number of motions that fit so many matches although all of them are wrong.

    ``(m − s) · C(m, k) · C(k, s) · pᵏ⁻ˢ`` (Moisan and Stival 2004, equation 6; the measure of
    OpenMVG, which the paper used).

    Args:
        matches: m.
        inliers: k, matches that fit.
        sample: s, matches that any motion can be made to fit.
        share: p, wrong matches that fit by chance.

    Returns:
        Natural logarithm; a motion below 0 is hardly one of chance.
    """
    if inliers <= sample:
        return math.inf
    return (
        math.log(matches - sample)
        + _log_choices(matches, inliers)
        + _log_choices(inliers, sample)
        + (inliers - sample) * math.log(share)
    )


def _log_choices(of: int, chosen: int) -> float:
    return math.lgamma(of + 1) - math.lgamma(chosen + 1) - math.lgamma(of - chosen + 1)


def prefers_rotation(
    general_errors: NDArray[np.float64],
    rotation_errors: NDArray[np.float64],
    max_error_rad: float,
    precision_rad: float,
) -> bool:
    """Whether a rotation alone explains the matches: Torr's GRIC (1998).

    ``Σ min(e²/σ², 2 (4 − d)) + n d ln 4 + k ln 4n`` with d = 3, k = 5 for a general motion and
    d = 2, k = 3 for a rotation, over the matches that one of the two allows; the smaller wins. σ
    is that of the general motion, from the median of its errors.

    Args:
        general_errors: ``(m,)`` radians.
        rotation_errors: ``(m,)`` radians.
        max_error_rad: How far off matches may be.
        precision_rad: Smallest σ.
    """
    fits = general_errors <= max_error_rad
    sigma = max(1.4826 * float(np.median(general_errors[fits])), precision_rad)
    either = fits | (rotation_errors <= max_error_rad)

    def cost(errors: NDArray[np.float64], dimension: int, freedom: int) -> float:
        count = int(either.sum())
        surprise = np.minimum((errors[either] / sigma) ** 2, 2 * (4 - dimension)).sum()
        return float(surprise + count * dimension * math.log(4) + freedom * math.log(4 * count))

    return cost(rotation_errors, 2, 3) < cost(general_errors, 3, 5)
