"""Panoramas from inside a textured ball: depth, pose and what is seen are closed forms."""

from __future__ import annotations

import numpy as np

from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPair
from tangent_train.geometry import (
    PanoramaPose,
    equirect_directions,
    random_rotation,
    to_right_handed,
)
from tests.keypoints.textures import volume_texture

RADIUS_M = 3.0
SHAPE = (192, 384)


def ball_panorama(name: str, pose: PanoramaPose, shape: tuple[int, int] = SHAPE) -> PairedPanorama:
    """The ball of radius 3 m around the origin, seen from within it."""
    directions = equirect_directions(shape)
    ahead = directions @ pose.world_from_panorama.T
    along = ahead @ pose.location_m
    distance = -along + np.sqrt(along**2 + RADIUS_M**2 - pose.location_m @ pose.location_m)
    points = pose.points_m(directions, distance) / RADIUS_M
    rgb = np.repeat(volume_texture(points, (8, 16, 32))[..., None], 3, axis=-1)
    return PairedPanorama(name, rgb, distance.astype(np.float32), pose)


def ball_pair(name: str = "ball", shape: tuple[int, int] = SHAPE) -> PanoramaPair:
    """Two panoramas 0.5 m apart, randomly rotated."""
    rng = np.random.default_rng(1)
    left = PanoramaPose(to_right_handed(random_rotation(rng)), [0.1, 0.2, -0.1])
    right = PanoramaPose(to_right_handed(random_rotation(rng)), [0.4, -0.2, -0.1])
    sides = (ball_panorama(f"{name}_l", left, shape), ball_panorama(f"{name}_r", right, shape))
    return PanoramaPair(name, None, *sides)
