"""Detectors on images, on panoramas and on tangent images, against closed forms."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tangent_train.geometry import TangentGrid, lonlat_to_xyz, random_rotation, rotation_about
from tangent_train.keypoints.features import (
    SphericalKeypoints,
    detect_on_equirect,
    detect_on_tangent_images,
)
from tests.geometry.directions import angle_deg
from tests.keypoints.textures import Agreement, blob, rotated, texture

LEVEL, SHAPE = 7, (256, 512)
ROTATION = random_rotation(np.random.default_rng(1))
DOG = 2 ** (1 / 6)
"""The DoG of a Gaussian blob of width s is largest at σ = s / this."""


# The panorama.


def test_keypoints_do_not_depend_on_the_seam() -> None:
    """A rolled panorama has the same keypoints, rolled, also at ±180°."""
    image, columns = texture(SHAPE), 200
    roll = rotation_about([0, 0, 1], columns / SHAPE[1] * 2 * np.pi)
    left = rotated(detect_on_equirect(image), roll)
    right = detect_on_equirect(np.roll(image, columns, axis=1))
    assert len(right) == pytest.approx(len(left), rel=0.01)
    agreement = Agreement(left, right)
    assert agreement.share > 0.99
    assert agreement.error_deg < 0.01
    near = np.abs(np.arctan2(left.directions_xyz[:, 1], -left.directions_xyz[:, 0])) < 0.05
    assert near.sum() > 30
    assert Agreement(left.select(near), right).share > 0.95


@pytest.mark.parametrize(("lon_deg", "lat_deg"), [(180.0, 10.0), (-179.8, 10), (0, 10), (30, -65)])
def test_a_blob_is_found_once_wherever_it_is(lon_deg: float, lat_deg: float) -> None:
    center = lonlat_to_xyz(np.deg2rad([lon_deg, lat_deg]))
    sigma = np.deg2rad(1.2 if lat_deg > 0 else 2.5)
    found = detect_on_equirect(blob(SHAPE, center, sigma))
    found = found.select(angle_deg(found.directions_xyz, center) < 5)
    assert len(np.unique(found.directions_xyz.round(4), axis=0)) == 1
    # OpenCV's default is off by a quarter of a pixel of 0.7°.
    assert angle_deg(found.directions_xyz, center).max() < (0.03 if lat_deg > 0 else 1)
    assert 2 * sigma / DOG / found.sizes_rad.min() == pytest.approx(1, abs=0.25)
    columns = found.equirect_pixels(SHAPE)[:, 0]
    assert ((columns >= -0.5) & (columns <= SHAPE[1] - 0.5)).all()


@pytest.mark.parametrize("tangent", [False, True])
def test_blank_panoramas_have_no_keypoints_and_color_is_converted(tangent: bool) -> None:
    def found(image: NDArray[np.uint8]) -> SphericalKeypoints:
        if tangent:
            return detect_on_tangent_images(image, TangentGrid(0, 5, dim=29), 21)
        return detect_on_equirect(image)

    assert len(found(np.full((101, 77, 3), 90, np.uint8))) == 0
    image = texture((101, 177))  # odd sizes
    gray, color = found(image), found(np.repeat(image[..., None], 3, axis=2))
    assert len(gray) > 30
    np.testing.assert_array_equal(gray.directions_xyz, color.directions_xyz)
    np.testing.assert_array_equal(gray.descriptors, color.descriptors)


# Tangent images.


@lru_cache
def found_on_texture(base_level: int, *, rotate: bool = False) -> SphericalKeypoints:
    image = texture(SHAPE, ROTATION if rotate else None)
    return detect_on_tangent_images(image, TangentGrid(base_level, LEVEL), 16)


@pytest.mark.parametrize("base_level", [0, 2])
def test_a_rotated_panorama_has_rotated_keypoints(base_level: int) -> None:
    left = rotated(found_on_texture(base_level), ROTATION)
    right = found_on_texture(base_level, rotate=True)
    agreement = Agreement(left, right)
    assert min(len(left), len(right)) > 900
    assert agreement.share > 0.7
    assert agreement.error_deg < 0.1
    assert agreement.size_ratio == pytest.approx(1, abs=0.01)
    assert agreement.size_spread < 0.03
    assert agreement.turn_deg < 3


# At base level 2 two keypoints of this texture are found on both sides of a border.
@pytest.mark.parametrize("base_level", [0, 2])
def test_every_keypoint_is_owned_by_its_image_and_occurs_once(base_level: int) -> None:
    points = found_on_texture(base_level)
    grid = TangentGrid(base_level, LEVEL)
    np.testing.assert_array_equal(grid.owners(points.directions_xyz), points.images)
    assert (np.diff(points.images) >= 0).all()
    left, right = cKDTree(points.directions_xyz).query_pairs(grid.pitch, output_type="ndarray").T
    other_image = points.images[left] != points.images[right]
    ratio = np.abs(np.log(points.sizes_rad[left] / points.sizes_rad[right]))
    angle = angle_deg(points.orientations_xyz[left], points.orientations_xyz[right])
    assert not (other_image & (ratio < np.log(1.1)) & (angle < 15)).any()
    inner = (points.directions_xyz * points.orientations_xyz).sum(axis=1)
    np.testing.assert_allclose(inner, 0, atol=1e-9)
