"""Keypoints, and matches of known motion, all around the sphere."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.geometry import PanoramaPose, random_rotation, to_right_handed
from tangent_train.keypoints import SphericalKeypoints
from tests.geometry.directions import unit


class Scene(NamedTuple):
    """Matches and the truth about them; the first `wrong` ones are wrong."""

    left_xyz: NDArray[np.float64]
    right_xyz: NDArray[np.float64]
    rotation: NDArray[np.float64]
    translation_m: NDArray[np.float64]
    left: PanoramaPose
    right: PanoramaPose
    wrong: int


def two_views(
    count: int, *, baseline_m: float = 0.5, wrong: int = 0, noise_deg: float = 0.0, seed: int = 0
) -> Scene:
    """Points 1.5 to 5 m around the left camera, in all directions."""
    rng = np.random.default_rng(seed)
    points_m = unit(rng.normal(size=(count, 3))) * rng.uniform(1.5, 5, (count, 1))
    special = np.array([(0, 0, 2), (0, 0, -2), (-3, 0, 0), (-2, 1e-3, 0.1)])
    points_m[:4] = special[:count]
    left = PanoramaPose(to_right_handed(random_rotation(rng)), np.zeros(3))
    right = PanoramaPose(
        to_right_handed(random_rotation(rng)), baseline_m * unit(rng.normal(size=3))
    )
    left_xyz, right_xyz = (pose.project(points_m)[0] for pose in (left, right))
    order = rng.permutation(count)  # the special points are not the wrong ones
    left_xyz, right_xyz = left_xyz[order], right_xyz[order]
    right_xyz[:wrong] = unit(rng.normal(size=(wrong, 3)))
    left_xyz += rng.normal(size=(count, 3)) * np.radians(noise_deg)
    right_xyz += rng.normal(size=(count, 3)) * np.radians(noise_deg)
    rotation, translation_m = right.relative_to(left)
    return Scene(unit(left_xyz), unit(right_xyz), rotation, translation_m, left, right, wrong)


def rotation_angle_deg(first: ArrayLike, second: ArrayLike) -> float:
    """Angle of the rotation from one to the other, by its trace."""
    trace = np.trace(np.asarray(first, np.float64) @ np.asarray(second, np.float64).T)
    return float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))))


def keypoints_at(directions_xyz: NDArray[np.float64]) -> SphericalKeypoints:
    """Keypoints of 2° in these directions, their orientation to the right."""
    n = len(directions_xyz)
    x, y, _ = directions_xyz.T
    right = np.stack([-y, x, 0 * x], axis=-1) / np.maximum(np.hypot(x, y), 1e-9)[:, None]
    return SphericalKeypoints(
        directions_xyz,
        np.full(n, np.radians(2), np.float32),
        right,
        np.ones(n, np.float32),
        np.random.default_rng(n).integers(0, 256, (n, 128)).astype(np.float32),
        np.zeros(n, np.int32),
    )
