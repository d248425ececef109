"""Normals of planes, spheres and boxes, whose distances have closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.geometry import (
    camera_matrix_from_fov,
    equirect_directions,
    perspective_directions,
)
from tangent_train.geometry.normals import equirect_normals, pinhole_normals
from tests.geometry.directions import angle_deg, random_directions

Floats = NDArray[np.float64]


@pytest.mark.parametrize("shape", [(64, 128), (33, 66)])
def test_planes_are_exact_also_at_seam_and_poles(shape: tuple[int, int]) -> None:
    """Up to the border of the known pixels: 2 m in front of the center, in random directions."""
    directions = equirect_directions(shape)
    for normal in [*random_directions(20), (0, 0, 1), (0, 0, -1), (-1, 0, 0)]:
        cosine = directions @ np.asarray(normal)
        distance = np.where(cosine > 0.05, 2 / np.where(cosine > 0.05, cosine, 1), 0)
        found = equirect_normals(distance.astype(np.float32))
        known = distance > 0
        assert np.isnan(found[~known]).all()
        assert np.isfinite(found[known]).all(axis=-1).mean() > 0.95
        np.testing.assert_allclose(found[known & np.isfinite(found[..., 0])] + normal, 0, atol=2e-3)


def _box(directions: Floats) -> tuple[Floats, Floats]:
    """Distances to the walls of a room seen from off its middle, and normals."""
    low, high = np.array([-1.3, -2.1, -1.4]), np.array([2.7, 1.2, 1.1])
    with np.errstate(divide="ignore"):
        distances = np.where(directions > 0, high, low) / directions
    axis = np.abs(distances).argmin(axis=-1)[..., None]
    normals = np.where(np.arange(3) == axis, -np.sign(directions), 0)
    return np.take_along_axis(np.abs(distances), axis, -1)[..., 0], normals


def test_edges_of_a_box_stay_sharp() -> None:
    """Also in the pixels beside an edge; central differences average the two walls there."""
    distance, normals = _box(equirect_directions((256, 512)))
    away = angle_deg(equirect_normals(distance), normals)
    assert np.quantile(away, 0.99) < 0.1
    assert (away > 1).mean() < 2e-3, "corners, and edges along rows or columns"


def test_a_ball_around_and_one_ahead() -> None:
    """|d r − c| = R: from inside the farther, from outside the nearer solution."""
    directions, radius = equirect_directions((256, 512)), 1.5
    for center, sign in ((np.array([0.5, 0.3, -0.6]), 1), (np.array([1.0, -2.0, 2.5]), -1)):
        along = directions @ center
        root = along**2 - center @ center + radius**2
        distance = np.where(root > 0, along + sign * np.sqrt(np.maximum(root, 0)), np.nan)
        expected = -sign * (directions * distance[..., None] - center) / radius
        away = angle_deg(equirect_normals(distance), expected)
        assert np.nanmax(away[root > 0.2]) < 3, "at the outline"
        assert np.nanmedian(away) < 0.2


def test_a_photo_of_a_corner() -> None:
    """Camera axes x right, y down, z ahead; the normal of a wall ahead is −z."""
    camera, size = camera_matrix_from_fov(75.0, (120, 160)), (120, 160)
    rays = perspective_directions(camera, size)
    turn = np.radians(30)
    rotation = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    distance, normals = _box(rays @ rotation.T)
    away = angle_deg(pinhole_normals(distance * rays[..., 2], camera), normals @ rotation)
    assert np.quantile(away, 0.99) < 0.1
    ahead = pinhole_normals(np.full(size, 3.0), camera)
    np.testing.assert_allclose(ahead, np.broadcast_to((0, 0, -1), ahead.shape), atol=1e-12)


def test_noise_is_averaged_evenly_near_the_poles() -> None:
    """A floor with 0.1 % of noise: errors of the rows differ by less than a factor of 4."""
    directions = equirect_directions((128, 256))[90:]
    noisy = np.zeros((128, 256))
    noise = np.random.default_rng(0).normal(1, 1e-3, directions.shape[:2])
    noisy[90:] = -1.5 / directions[..., 2] * noise
    away = angle_deg(equirect_normals(noisy)[92:], np.array([0.0, 0.0, 1.0]))
    of_rows = np.median(away, axis=1)
    assert of_rows.max() < 4 * of_rows.min()
