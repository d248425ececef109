"""Panoramas in closed form: rotated panoramas are computed, not resampled."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from tangent_train.geometry import equirect_directions
from tangent_train.keypoints.features import SphericalKeypoints
from tests.geometry.directions import angle_deg


def texture(
    shape: tuple[int, int], rotation: ArrayLike | None = None, seed: int = 0
) -> NDArray[np.uint8]:
    """A sphere cut out of random gray volumes, isotropic; rotated, direction d shows Rᵀd."""
    directions = equirect_directions(shape)
    if rotation is not None:
        directions = directions @ np.asarray(rotation)
    return volume_texture(directions, (10, 20, 40, 80), seed)


def volume_texture(
    points_xyz: NDArray[np.float64], cells: Sequence[int], seed: int = 0
) -> NDArray[np.uint8]:
    """Gray values of random volumes, of so many cells along a side, in the unit ball."""
    rng = np.random.default_rng(seed)
    gray = np.zeros(points_xyz.shape[:-1])
    for side in cells:
        volume = rng.standard_normal((side + 4,) * 3)
        places = np.moveaxis((points_xyz + 1) / 2 * side + 1.5, -1, 0)
        gray += map_coordinates(volume, places, order=3) * side**-0.25
    return _as_bytes(127 + 75 * gray)


def blob(
    shape: tuple[int, int], center_xyz: NDArray[np.float64], sigma_rad: float
) -> NDArray[np.uint8]:
    """A bright Gaussian blob on gray: 60 + 150 exp(−angle² / 2σ²)."""
    chord = ((equirect_directions(shape) - center_xyz) ** 2).sum(axis=-1)
    angle = 2 * np.arcsin(np.sqrt(chord) / 2)
    return _as_bytes(60 + 150 * np.exp(-(angle**2) / (2 * sigma_rad**2)))


def _as_bytes(gray: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.rint(gray.clip(0, 255)).astype(np.uint8)


def rotated(points: SphericalKeypoints, rotation: ArrayLike) -> SphericalKeypoints:
    """The keypoints of the rotated panorama: directions and orientations become R·d."""
    matrix = np.asarray(rotation)
    return replace(
        points,
        directions_xyz=points.directions_xyz @ matrix.T,
        orientations_xyz=points.orientations_xyz @ matrix.T,
    )


class Agreement:
    """Pairs keypoints of two panoramas: each with the most similar one nearby.

    Attributes:
        share: Share of keypoints that have another of similar size within 1°.
        error_deg: Median angle between such pairs.
        size_ratio: Median ratio of their sizes.
        size_spread: Median of the absolute logarithm of this ratio.
        turn_deg: Median angle between their orientations.
    """

    def __init__(self, left: SphericalKeypoints, right: SphericalKeypoints) -> None:
        tree = cKDTree(right.directions_xyz)
        reach = 2 * np.sin(np.deg2rad(1) / 2)
        _, near = tree.query(left.directions_xyz, k=12, distance_upper_bound=reach)
        there = near < len(right)
        near[~there] = 0
        there &= np.abs(np.log(left.sizes_rad[:, None] / right.sizes_rad[near])) < np.log(1.4)
        difference = left.descriptors[:, None].astype(np.float64) - right.descriptors[near]
        distance = np.where(there, (difference**2).sum(axis=-1), np.inf)
        found = there.any(axis=1)
        nearest = near[np.arange(len(left)), distance.argmin(axis=1)][found]
        left, right = left.select(found), right.select(nearest)
        ratios = right.sizes_rad / left.sizes_rad
        self.share = found.mean()
        self.error_deg = np.median(angle_deg(left.directions_xyz, right.directions_xyz))
        self.size_ratio = np.median(ratios)
        self.size_spread = np.median(np.abs(np.log(ratios)))
        self.turn_deg = np.median(angle_deg(left.orientations_xyz, right.orientations_xyz))
