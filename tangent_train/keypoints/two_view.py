"""Two-view geometry of panoramas: estimate their motion from matches, most of them outliers.

A point in direction l of the left panorama lies on a ray at an unknown distance. In the right
panorama, with ``x_right = R x_left + t``, the ray appears as a great-circle arc. It starts at
``R l``, the ray's point at infinity, and ends at ``t``, the left center. Without translation the
arc is the point ``R l``.

Arguments of pycolmap are in COLMAP's camera axes: x right, y down, z to the panorama's middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import of_extra
from tangent_train.geometry import PanoramaPose
from tangent_train.geometry.sphere import Floats
from tangent_train.keypoints.features import angles_between

_CAMERA_FROM_PANORAMA = np.array([[0, 1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])
"""From the axes of `tangent_train.geometry` to COLMAP's; a reflection."""

_MIN_INLIERS = 8
"""COLMAP requires 15. Fewer are reliable here, because motions by chance are rejected."""

_MAX_TRIALS = 50_000
_STARTS = 4
_DRAWS, _HYPOTHESES = 2**15, 512
"""Random pairs of matches for a rotation, and hypotheses tested: enough for 2 % inliers."""

_REFINEMENTS = 6
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


@dataclass(frozen=True, eq=False)
class TwoView:
    """Estimated motion ``x_right = R x_left + t`` in the axes of `tangent_train.geometry`.

    Attributes:
        inliers: ``(m,)`` bool, matches whose error is small enough.
        rotation: ``(3, 3)`` R; None if no motion was found that is better than chance.
        translation: ``(3,)`` t of length 1, the direction of the left center in the right panorama;
            None without a motion, and for a pure rotation.
    """

    inliers: NDArray[np.bool_]
    rotation: Floats | None = None
    translation: Floats | None = None

    @property
    def kind(self) -> Literal["general", "rotation", "none"]:
        """Kind of the motion: ``general`` has a translation."""
        if self.rotation is None:
            return "none"
        return "rotation" if self.translation is None else "general"

    def pose_error_deg(self, left: PanoramaPose, right: PanoramaPose) -> tuple[float, float]:
        """Return the errors of rotation and translation, given the true poses.

        Args:
            left: True pose of the left panorama.
            right: True pose of the right panorama.

        Returns:
            Angle between the rotations, and angle between the directions of translation, in
            degrees. NaN if the estimate has no rotation or translation, or the true centers
            coincide.
        """
        rotation, translation_m = right.relative_to(left)
        rotation_error = translation_error = math.nan
        if self.rotation is not None:
            # |R − R'| = 2 √2 sin(α / 2), which is precise for small angles.
            chord = float(np.linalg.norm(self.rotation - rotation)) / math.sqrt(8)
            rotation_error = math.degrees(2 * math.asin(min(chord, 1.0)))
        length = float(np.linalg.norm(translation_m))
        if self.translation is not None and length > 0:
            true = translation_m / length
            translation_error = math.degrees(angles_between(self.translation, true))
        return rotation_error, translation_error


def estimate_two_view(
    left_xyz: Floats, right_xyz: Floats, max_error_deg: float = 1.0, *, seed: int = 0
) -> TwoView:
    """Estimate the motion between two panoramas from matches with outliers.

    A general motion is estimated by COLMAP's five-point RANSAC, a rotation from pairs of matches.
    Torr's criterion decides between them (`prefers_rotation`), because a general motion also fits
    the matches of a rotation. A motion that is expected by chance is rejected (`is_by_chance`).

    Args:
        left_xyz: ``(m, 3)`` unit vectors in the left panorama.
        right_xyz: ``(m, 3)`` unit vectors in the right panorama.
        max_error_deg: Largest error of an inlier.
        seed: Seed of the random samples.

    Returns:
        The motion and its inliers; without a motion, all matches are outliers.

    Raises:
        SettingError: pycolmap is missing.
    """
    no_motion, max_error_rad = (
        TwoView(np.zeros(len(left_xyz), np.bool_)),
        math.radians(max_error_deg),
    )
    if len(left_xyz) < _MIN_INLIERS:
        return no_motion
    search = _Search(left_xyz, right_xyz, max_error_rad, seed)
    general, motion = search.general(), search.rotation()
    if motion is None or (
        general is not None
        and not prefers_rotation(search.errors(general), search.errors(motion), max_error_rad)
    ):
        motion = general
    if motion is None or is_by_chance(left_xyz, right_xyz, motion, max_error_rad):
        return no_motion
    inliers = search.errors(motion) <= max_error_rad
    return TwoView(inliers, *motion) if inliers.sum() >= _MIN_INLIERS else no_motion


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
    choices = math.log(m - s) + math.log(math.comb(m, k)) + math.log(math.comb(k, s))
    return choices + (k - s) * math.log(share) > 0


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
    n, costs = int(either.sum()), []
    for errors, d, k in ((general_errors, 3, 5), (rotation_errors, 2, 3)):
        misfit = np.minimum((errors[either] / sigma) ** 2, 2 * (4 - d)).sum()
        costs.append(float(misfit + n * d * math.log(4) + k * math.log(4 * n)))
    return costs[1] < costs[0]


@dataclass(frozen=True)
class _Search:
    """Searches a motion that fits matches."""

    left_xyz: Floats
    right_xyz: Floats
    max_error_rad: float
    seed: int

    def errors(self, motion: Motion) -> Floats:
        return motion_errors(self.left_xyz, self.right_xyz, motion)

    def cost(self, motion: Motion) -> float:
        return float((np.minimum(self.errors(motion), self.max_error_rad) ** 2).sum())

    def general(self) -> Motion | None:
        """Return the best of several runs of COLMAP's LO-RANSAC on rays, each refined.

        A single run may return a motion that is degrees off but fits nearly as many matches.
        `pycolmap.estimate_calibrated_two_view_geometry` is not used: it measures errors in pixels
        of the panorama and loses matches near the poles.
        """
        pycolmap = colmap()
        left, right = (rays @ _CAMERA_FROM_PANORAMA.T for rays in (self.left_xyz, self.right_xyz))

        def refit(chosen: NDArray[np.bool_], motion: Motion) -> Motion | None:
            pose = pycolmap.Rigid3d(rigid_matrix(*motion))
            refined = pycolmap.refine_relative_pose(pose, left, right, chosen)
            return None if refined is None else _motion(refined["cam2_from_cam1"])

        options = pycolmap.RANSACOptions()
        # The Sampson error is 1/√2 of the one-sided error if both sides have the same weight.
        options.max_error = self.max_error_rad / math.sqrt(2)
        options.max_num_trials = _MAX_TRIALS // _STARTS
        options.min_inlier_ratio = 0.01
        options.confidence = 0.9999
        found: list[Motion] = []
        for number in np.random.SeedSequence(self.seed).generate_state(_STARTS) % 2**31:
            options.random_seed = int(number)
            start = pycolmap.estimate_relative_pose(left, right, options)
            if start is not None:
                rotation, t = _motion(start["cam2_from_cam1"])
                # COLMAP selects among the four motions of an essential matrix (Hartley and
                # Zisserman, result 9.19) by counting points in front of both cameras, which is
                # unreliable if rays are nearly parallel.
                twin = (2 * np.outer(t, t) - np.eye(3)) @ rotation
                motions = [Motion(r, sign * t) for r in (rotation, twin) for sign in (1, -1)]
                found += [self._refined(motion, refit) for motion in motions]
        return min(found, key=self.cost, default=None)

    def rotation(self) -> Motion | None:
        """Return the best rotation among those that fit two matches each, refined."""
        rng = np.random.default_rng(self.seed)
        pairs = rng.integers(0, len(self.left_xyz), (_DRAWS, 2))
        # A rotation keeps the angle between two directions; parallel ones do not determine it.
        apart, other = (
            np.linalg.norm(np.diff(rays[pairs], axis=1)[:, 0], axis=-1)
            for rays in (self.left_xyz, self.right_xyz)
        )
        usable = np.abs(apart - other) < 2 * self.max_error_rad
        usable &= apart > 10 * self.max_error_rad
        usable &= apart < 2 * math.cos(5 * self.max_error_rad)
        chosen = pairs[usable][:_HYPOTHESES]
        if not len(chosen):
            return None
        rotations = _rotations(self.left_xyz[chosen], self.right_xyz[chosen])
        # |R l − r|² = 2 − 2 Σ R_ij r_i l_j, for all rotations and matches in one product.
        products = np.einsum("mi,mj->ijm", self.right_xyz, self.left_xyz).reshape(9, -1)
        squares = 2 - 2 * rotations.reshape(-1, 9) @ products
        costs = np.minimum(squares, self.max_error_rad**2).sum(axis=1)

        def refit(fits: NDArray[np.bool_], _: Motion) -> Motion:
            return Motion(_rotations(self.left_xyz[fits], self.right_xyz[fits]))

        return self._refined(Motion(rotations[int(np.argmin(costs))]), refit)

    def _refined(
        self, motion: Motion, refit: Callable[[NDArray[np.bool_], Motion], Motion | None]
    ) -> Motion:
        """Fit a motion to its inliers again as long as the cost decreases."""
        for _ in range(_REFINEMENTS):
            errors = self.errors(motion)
            fits = errors <= self.max_error_rad
            if fits.sum() < 2 * motion.sample:
                break
            # Inliers with errors far above the median are probably wrong matches.
            sigma = 1.4826 * float(np.median(errors[fits]))
            better = refit(errors <= min(self.max_error_rad, 3 * sigma + 1e-9), motion)
            if better is None or self.cost(better) >= self.cost(motion):
                break
            motion = better
        return motion


def colmap() -> Any:
    """Import and return the module ``pycolmap``.

    Raises:
        SettingError: It is not installed.
    """
    with of_extra("keypoints", "keypoints"):
        import pycolmap
    return pycolmap


def rigid_matrix(rotation: Floats, translation: Floats | None) -> Floats:
    """Convert a motion in the axes of `tangent_train.geometry` to COLMAP's ``(3, 4)`` [R | t]."""
    axes = _CAMERA_FROM_PANORAMA
    shift = np.zeros(3) if translation is None else axes @ translation
    return np.column_stack([axes @ rotation @ axes.T, shift])


def _motion(cam2_from_cam1: Any) -> Any:
    """Convert a motion from COLMAP's axes to those of `tangent_train.geometry`."""
    axes = _CAMERA_FROM_PANORAMA
    translation = axes.T @ cam2_from_cam1.translation
    rotation = axes.T @ cam2_from_cam1.rotation.matrix() @ axes
    return Motion(rotation, translation / np.linalg.norm(translation))


def _rotations(left_xyz: Floats, right_xyz: Floats) -> Floats:
    """Return ``(..., 3, 3)`` least-squares rotations from left to right (Kabsch)."""
    u, _, vt = np.linalg.svd(np.swapaxes(right_xyz, -1, -2) @ left_xyz)
    u[..., -1] *= np.linalg.det(u @ vt)[..., None]
    rotations: Floats = u @ vt
    return rotations
