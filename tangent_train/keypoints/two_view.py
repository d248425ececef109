"""The motion between two panoramas, and which matches agree with it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from tangent_train.errors import SettingError
from tangent_train.keypoints.epipolar import (
    Motion,
    chance_share,
    log_false_alarms,
    motion_errors,
    prefers_rotation,
)
from tangent_train.keypoints.motion_search import find_motion, find_rotation
from tangent_train.keypoints.spherical import angles_between, unit_directions

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from tangent_train.geometry import PanoramaPose

__all__ = ["Kind", "TwoView", "estimate_two_view"]

Kind = Literal["general", "rotation", "none"]

_SAMPLE = 5
"""Matches that some essential matrix fits whatever they are."""

_PRECISION_RAD = math.radians(0.01)
"""Better than any keypoint: differences below it say nothing."""


@dataclass(frozen=True, eq=False)
class TwoView:
    """How the right panorama was taken, seen from the left one: ``x_right = R x_left + t``.

    Both in the axes of `tangent_train.geometry`. Two images do not tell the length of t.

    Attributes:
        kind: ``general``; ``rotation``, both were taken at one place as far as the matches tell;
            ``none``, no motion fits more matches than chance would.
        inliers: ``(m,)`` bool, matches within the largest error of the motion; none for ``none``.
        errors_deg: ``(m,)`` float64 angles between the matches and where the motion allows them
            (`motion_errors`), one criterion for both kinds; NaN for ``none``.
        rotation: ``(3, 3)`` R, None for ``none``.
        translation: ``(3,)`` t of length 1, the direction of the left centre in the right panorama;
            None unless ``general``.
    """

    kind: Kind
    inliers: NDArray[np.bool_]
    errors_deg: NDArray[np.float64]
    rotation: NDArray[np.float64] | None
    translation: NDArray[np.float64] | None

    @property
    def essential(self) -> NDArray[np.float64] | None:
        """``(3, 3)`` E = [t]ₓ R with ``rightᵀ E left = 0``; None unless ``general``."""
        if self.rotation is None or self.translation is None:
            return None
        x, y, z = self.translation
        return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ self.rotation

    def right_pose(self, left: PanoramaPose, baseline_m: float = 1.0) -> PanoramaPose | None:
        """Pose of the right panorama.

        Args:
            left: Pose of the left one.
            baseline_m: Distance between the two, which images do not tell.

        Returns:
            None for ``none``.
        """
        if self.rotation is None:
            return None
        if self.translation is None:
            return left.moved(self.rotation, np.zeros(3))
        return left.moved(self.rotation, baseline_m * self.translation)

    def pose_error_deg(self, left: PanoramaPose, right: PanoramaPose) -> tuple[float, float]:
        """Difference from true poses.

        Args:
            left: True pose of the left panorama.
            right: True pose of the right one.

        Returns:
            Angle between the rotations, and angle between the directions of translation, both in
            degrees from 0 to 180; NaN where one of the two is unknown or the true centres are one.
        """
        rotation, translation_m = right.relative_to(left)
        turn = shift = math.nan
        if self.rotation is not None:
            # |R − R'| = 2 √2 sin(α / 2), which is precise for small angles.
            chord = float(np.linalg.norm(self.rotation - rotation)) / math.sqrt(8)
            turn = math.degrees(2 * math.asin(min(chord, 1.0)))
        length = float(np.linalg.norm(translation_m))
        if self.translation is not None and length > 0:
            true = translation_m / length
            shift = math.degrees(angles_between(self.translation, true))
        return turn, shift


def estimate_two_view(
    left_xyz: ArrayLike,
    right_xyz: ArrayLike,
    max_error_deg: float = 1.0,
    *,
    seed: int = 0,
    min_inliers: int = 8,
    max_trials: int = 50_000,
) -> TwoView:
    """Find the motion between two panoramas from putative matches, all around the sphere.

    A general motion comes from COLMAP's five-point RANSAC (`find_motion`), a rotation from pairs of
    matches; Torr's criterion decides between them (`prefers_rotation`), because a general motion
    fits the matches of a rotation, too, with any translation. What is left must fit more matches
    than a motion would by chance (`log_false_alarms`): some motion fits 30 of 3000 wrong ones.
    The same matches and seed give the same result.

    Args:
        left_xyz: ``(m, 3)`` directions in the left panorama, of any length but 0.
        right_xyz: ``(m, 3)`` directions in the right one.
        max_error_deg: How far off inliers may be, above 0 and up to 20 degrees.
        seed: Of the random samples, 0 or more.
        min_inliers: With fewer there is no motion. COLMAP asks for 15; the test for chance makes
            fewer trustworthy. At least 6: some motion fits any five matches.
        max_trials: Most samples of five matches.

    Raises:
        SettingError: The directions or a setting cannot be used, or pycolmap is missing.
    """
    left, right = unit_directions(left_xyz), unit_directions(right_xyz)
    if len(left) != len(right):
        found = f"{len(left)} and {len(right)}"
        raise SettingError("matched directions", found=found, expected="as many on either side")
    _check(max_error_deg, seed, min_inliers, max_trials)
    max_error_rad = math.radians(max_error_deg)
    if len(left) < min_inliers:
        return _nothing(len(left))
    general = find_motion(left, right, max_error_rad, seed=seed, max_trials=max_trials)
    rotation = find_rotation(left, right, max_error_rad, seed=seed)
    motion = _preferred(left, right, general, rotation, max_error_rad)
    if motion is None:
        return _nothing(len(left))
    errors_rad = motion_errors(left, right, motion)
    inliers = errors_rad <= max_error_rad
    count = int(inliers.sum())
    share = chance_share(left, right, motion, max_error_rad)
    if count < min_inliers or log_false_alarms(len(left), count, motion.sample, share) > 0:
        return _nothing(len(left))
    kind: Kind = "rotation" if motion.translation is None else "general"
    return TwoView(kind, inliers, np.degrees(errors_rad), *motion)


def _preferred(
    left_xyz: NDArray[np.float64],
    right_xyz: NDArray[np.float64],
    general: Motion | None,
    rotation: Motion | None,
    max_error_rad: float,
) -> Motion | None:
    if general is None or rotation is None:
        return general or rotation
    moved, turned = (motion_errors(left_xyz, right_xyz, way) for way in (general, rotation))
    if not (moved <= max_error_rad).any():
        return rotation
    return rotation if prefers_rotation(moved, turned, max_error_rad, _PRECISION_RAD) else general


def _nothing(count: int) -> TwoView:
    return TwoView("none", np.zeros(count, np.bool_), np.full(count, np.nan), None, None)


def _check(max_error_deg: float, seed: int, min_inliers: int, max_trials: int) -> None:
    for name, value, good, expected in (
        ("max_error_deg", max_error_deg, 0 < max_error_deg <= 20, "above 0, at most 20"),
        ("seed", seed, 0 <= seed < 2**31, "0 to 2147483647"),
        ("min_inliers", min_inliers, min_inliers > _SAMPLE, f"{_SAMPLE + 1} or more"),
        ("max_trials", max_trials, max_trials >= 1, "1 or more"),
    ):
        if not good:
            raise SettingError(name, found=value, expected=expected)
