"""Panoramas from inside a textured ball: depth, pose and what is seen are closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPair
from tangent_train.geometry import FLIP_Y, PanoramaPose, equirect_directions, random_rotation

RADIUS_M = 3.0
SHAPE = (192, 384)


def ball_panorama(name: str, pose: PanoramaPose, shape: tuple[int, int] = SHAPE) -> PairedPanorama:
    """The ball of radius 3 m around the origin, seen from within it."""
    directions = equirect_directions(shape)
    ahead = directions @ pose.world_from_panorama.T
    along = ahead @ pose.location_m
    distance = -along + np.sqrt(along**2 + RADIUS_M**2 - pose.location_m @ pose.location_m)
    points = pose.points_m(directions, distance) / RADIUS_M
    rgb = np.repeat(_texture(points)[..., None], 3, axis=-1)
    return PairedPanorama(name, rgb, Path(f"{name}.png"), distance.astype(np.float32), pose)


def ball_pair(name: str = "ball", shape: tuple[int, int] = SHAPE) -> PanoramaPair:
    """Two panoramas 0.5 m apart, randomly rotated."""
    rng = np.random.default_rng(1)
    left = PanoramaPose(random_rotation(rng) @ FLIP_Y, [0.1, 0.2, -0.1])
    right = PanoramaPose(random_rotation(rng) @ FLIP_Y, [0.4, -0.2, -0.1])
    return PanoramaPair(
        name,
        None,
        ball_panorama(f"{name}_l", left, shape),
        ball_panorama(f"{name}_r", right, shape),
    )


def _texture(points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Grey values of a random volume at ``(…, 3)`` points of the unit ball."""
    rng = np.random.default_rng(0)
    grey = np.zeros(points.shape[:-1])
    for cells in (8, 16, 32):
        volume = rng.standard_normal((cells + 4,) * 3)
        places = np.moveaxis((points + 1) / 2 * cells + 1.5, -1, 0)
        grey += map_coordinates(volume, places, order=3)
    return np.rint((127 + 50 * grey).clip(0, 255)).astype(np.uint8)
