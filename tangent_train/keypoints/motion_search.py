"""Finding the motion between two panoramas among matches of which most may be wrong."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from tangent_train.errors import SettingError
from tangent_train.keypoints.epipolar import Motion, motion_errors

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

__all__ = ["CAMERA_FROM_PANORAMA", "colmap", "find_motion", "find_rotation", "rigid_matrix"]

CAMERA_FROM_PANORAMA: NDArray[np.float64] = np.array([[0, 1.0, 0], [0, 0, -1.0], [1.0, 0, 0]])
"""From `tangent_train.geometry`'s axes to COLMAP's x right, y down, z to the middle; it mirrors."""
CAMERA_FROM_PANORAMA.setflags(write=False)

_DRAWS = 2**15
"""Pairs of matches tried for a rotation: a right one is among them at 2 % of inliers, surely."""
_HYPOTHESES = 512
_REFINEMENTS = 6
_STARTS = 4


def colmap() -> Any:
    """The module ``pycolmap``.

    Raises:
        SettingError: It is not installed.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise SettingError(
            "geometry of two panoramas",
            found="no pycolmap",
            expected="the packages of the extra keypoints",
            remedy="Run: pip install 'tangent-train[keypoints]'",
        ) from error
    return pycolmap


def find_motion(
    left_xyz: NDArray[np.float64],
    right_xyz: NDArray[np.float64],
    max_error_rad: float,
    *,
    seed: int,
    max_trials: int,
) -> Motion | None:
    """A motion with a translation that many matches fit.

    COLMAP's five-point LO-RANSAC on rays (`pycolmap.estimate_relative_pose`), several times, each
    refined on the matches that fit; of these the one with the least ``Σ min(e, max_error)²``.
    A single run may stop at a motion that is degrees away and fits nearly as many.
    `pycolmap.estimate_calibrated_two_view_geometry` finds the same motions with its camera
    EQUIRECTANGULAR, but measures errors in pixels of the ERP, so that it loses matches near the
    poles, and spends most of its time on homographies: with nine wrong matches in ten it often
    fails where this still finds the motion.

    Args:
        left_xyz: ``(m, 3)`` unit vectors.
        right_xyz: ``(m, 3)`` unit vectors.
        max_error_rad: How far off matches may be.
        seed: Of the random samples.
        max_trials: Most samples, of all runs together.

    Returns:
        None where COLMAP finds none.

    Raises:
        SettingError: pycolmap is missing.
    """
    pycolmap = colmap()
    left, right = (rays @ CAMERA_FROM_PANORAMA.T for rays in (left_xyz, right_xyz))

    def refit(chosen: NDArray[np.bool_], motion: Motion) -> Motion | None:
        pose = pycolmap.Rigid3d(rigid_matrix(motion.rotation, motion.translation))
        refined = pycolmap.refine_relative_pose(pose, left, right, chosen)
        return None if refined is None else _motion(refined["cam2_from_cam1"])

    best, least = None, math.inf
    for number in np.random.SeedSequence(seed).generate_state(_STARTS) % 2**31:
        options = _ransac_options(max_error_rad, int(number), math.ceil(max_trials / _STARTS))
        found = pycolmap.estimate_relative_pose(left, right, options)
        # COLMAP's choice among the four motions of an essential matrix counts rays that meet in
        # front of both; where they are nearly parallel that is noise.
        for start in [] if found is None else _twins(_motion(found["cam2_from_cam1"])):
            motion = _refined(start, left_xyz, right_xyz, max_error_rad, refit)
            cost = _cost(motion_errors(left_xyz, right_xyz, motion), max_error_rad)
            if cost < least:
                best, least = motion, cost
    return best


def _ransac_options(max_error_rad: float, seed: int, max_trials: int) -> Any:
    options = colmap().RANSACOptions()
    # The Sampson error is a one-sided one over √2 where both sides weigh the same.
    options.max_error = max_error_rad / math.sqrt(2)
    options.random_seed = seed
    options.max_num_trials = max_trials
    options.min_num_trials = min(options.min_num_trials, max_trials)
    options.min_inlier_ratio = 0.01
    options.confidence = 0.9999
    return options


def find_rotation(
    left_xyz: NDArray[np.float64],
    right_xyz: NDArray[np.float64],
    max_error_rad: float,
    *,
    seed: int,
) -> Motion | None:
    """A rotation that many matches fit: of pairs of matches, the best, refined.

    Args:
        left_xyz: ``(m, 3)`` unit vectors.
        right_xyz: ``(m, 3)`` unit vectors.
        max_error_rad: How far off matches may be.
        seed: Of the random samples.

    Returns:
        None where no two matches are turned by the same rotation.
    """
    rng = np.random.default_rng(seed)
    pairs = rng.integers(0, len(left_xyz), (_DRAWS, 2))
    # A rotation keeps the angle between two directions; those nearly parallel fix no rotation.
    apart = [
        np.linalg.norm(np.diff(rays[pairs], axis=1)[:, 0], axis=-1)
        for rays in (left_xyz, right_xyz)
    ]
    same = np.abs(apart[0] - apart[1]) < 2 * max_error_rad
    wide = (apart[0] > 10 * max_error_rad) & (apart[0] < 2 * math.cos(5 * max_error_rad))
    chosen = pairs[same & wide][:_HYPOTHESES]
    if not len(chosen):
        return None
    turns = _turns(left_xyz[chosen], right_xyz[chosen])
    # |R l − r|² = 2 − 2 Σ R_ij r_i l_j, for all rotations and matches in one product.
    products = np.einsum("mi,mj->ijm", right_xyz, left_xyz).reshape(9, -1)
    squares = 2 - 2 * turns.reshape(-1, 9) @ products
    costs = np.minimum(squares, max_error_rad**2).sum(axis=1)

    def refit(fits: NDArray[np.bool_], _: Motion) -> Motion:
        return Motion(_turns(left_xyz[fits], right_xyz[fits]), None)

    best = Motion(turns[int(np.argmin(costs))], None)
    return _refined(best, left_xyz, right_xyz, max_error_rad, refit)


def _refined(
    motion: Motion,
    left_xyz: NDArray[np.float64],
    right_xyz: NDArray[np.float64],
    max_error_rad: float,
    refit: Callable[[NDArray[np.bool_], Motion], Motion | None],
) -> Motion:
    """Fit again to what fits well, as long as that lowers the cost."""
    errors = motion_errors(left_xyz, right_xyz, motion)
    for _ in range(_REFINEMENTS):
        fits = errors <= max_error_rad
        if fits.sum() < 2 * motion.sample:
            break
        # What is far off for this scene is rather a wrong match that fits by chance.
        sigma = 1.4826 * float(np.median(errors[fits]))
        better = refit(errors <= min(max_error_rad, 3 * sigma + 1e-9), motion)
        if better is None:
            break
        now = motion_errors(left_xyz, right_xyz, better)
        if _cost(now, max_error_rad) >= _cost(errors, max_error_rad):
            break
        motion, errors = better, now
    return motion


def _cost(errors: NDArray[np.float64], max_error_rad: float) -> float:
    return float((np.minimum(errors, max_error_rad) ** 2).sum())


def _turns(left_xyz: NDArray[np.float64], right_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotations of least squares between R·left and right (Kabsch): ``(…, 3, 3)``."""
    u, _, vt = np.linalg.svd(np.swapaxes(right_xyz, -1, -2) @ left_xyz)
    u[..., -1] *= np.linalg.det(u @ vt)[..., None]
    turns: NDArray[np.float64] = u @ vt
    return turns


def _twins(start: Motion) -> list[Motion]:
    """The four motions of one essential matrix (Hartley and Zisserman, result 9.19)."""
    rotation, t = start
    if t is None:
        return [start]
    half_turn = 2 * np.outer(t, t) - np.eye(3)
    return [Motion(turn, way) for turn in (rotation, half_turn @ rotation) for way in (t, -t)]


def _motion(cam2_from_cam1: Any) -> Motion:
    """COLMAP's motion in the axes of `tangent_train.geometry`."""
    axes = CAMERA_FROM_PANORAMA
    translation = axes.T @ cam2_from_cam1.translation
    rotation = axes.T @ cam2_from_cam1.rotation.matrix() @ axes
    return Motion(rotation, translation / np.linalg.norm(translation))


def rigid_matrix(
    rotation: NDArray[np.float64], translation: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """``(3, 4)`` [R | t] in COLMAP's axes of a motion in those of `tangent_train.geometry`."""
    axes = CAMERA_FROM_PANORAMA
    shift = np.zeros(3) if translation is None else axes @ translation
    return np.column_stack([axes @ rotation @ axes.T, shift])
