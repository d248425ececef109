"""Detectors on images, on panoramas and on tangent images, against closed forms."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tangent_train.geometry import (
    TangentGrid,
    icosphere,
    lonlat_to_xyz,
    random_rotation,
    rotation_about,
)
from tangent_train.keypoints.detect import (
    Detections,
    Detector,
    detect_on_equirect,
    detect_on_tangent_images,
    gnomonic_jacobian,
)
from tangent_train.keypoints.spherical import SphericalKeypoints
from tests.geometry.directions import angle_deg, unit
from tests.keypoints.textures import Agreement, blobs, rotated, texture

LEVEL, SHAPE = 7, (256, 512)
ROTATION = random_rotation(np.random.default_rng(1))
DOG = 2 ** (1 / 6)
"""The DoG of a Gaussian blob of width s is largest at σ = s / this."""


# One image.


def flat_blobs(
    centers_xy: NDArray[np.float64], sigmas: NDArray[np.float64], size: tuple[int, int]
) -> NDArray[np.uint8]:
    y, x = np.mgrid[: size[0], : size[1]].astype(np.float64)
    grey = np.full(size, 60.0)
    for (cx, cy), sigma in zip(centers_xy, sigmas, strict=True):
        near = np.exp(-((x[0] - cx) ** 2) / (2 * sigma**2))
        grey += 150 * near * np.exp(-((y[:, :1] - cy) ** 2) / (2 * sigma**2))
    return np.rint(grey.clip(0, 255)).astype(np.uint8)


def scattered(seed: int, size: tuple[int, int]) -> NDArray[np.float64]:
    """Places at random fractions of a pixel, far from each other and the borders."""
    rng = np.random.default_rng(seed)
    places = np.empty((0, 2))
    for place in rng.uniform(50, np.array(size[::-1]) - 50, (600, 2)):
        if (np.hypot(*(places - place).T) > 42).all():
            places = np.vstack([places, place])
    return places


def errors(found: Detections, centers_xy: NDArray[np.float64], reach: float) -> Any:
    """Error, place and size of what is within reach of a centre."""
    offsets = found.points_xy[:, None] - centers_xy
    nearest = np.linalg.norm(offsets, axis=-1).argmin(axis=1)
    error = offsets[np.arange(len(nearest)), nearest]
    near = np.linalg.norm(error, axis=1) < reach
    return error[near], found.points_xy[near], found.sizes[near]


def test_orbs_levels_are_where_they_belong() -> None:
    """Pixels of level k are 1.2^k wide: on average nothing may be left of that, anywhere."""
    size = (611, 523)  # does not divide by the scales
    parts = []
    for seed in range(8):
        centers = scattered(seed, size)
        sigmas = np.random.default_rng(seed).uniform(1.5, 6, len(centers))
        found = Detector("orb").detect(flat_blobs(centers, sigmas, size))
        parts.append(errors(found, centers, 8))
    error, place, diameter = map(np.concatenate, zip(*parts, strict=True))
    lever = place / ((np.array(size[::-1]) - 1) / 2) - 1
    for level in range(8):
        of_level = np.isclose(diameter, 31 * 1.2**level, rtol=0.01)
        assert np.abs(error[of_level].mean(axis=0)).max() < 0.2
        trend = (error * lever)[of_level].mean(axis=0) / (lever[of_level] ** 2).mean(axis=0)
        assert np.abs(trend).max() < 0.6


@pytest.mark.parametrize("name", ["sift", "orb"])
def test_arrays_fit_together(name: str) -> None:
    image = np.random.default_rng(0).integers(0, 256, (120, 150), np.uint8)
    detector = Detector(name)
    kind, width = ("float32", 128) if detector.norm == "l2" else ("uint8", 32)
    blank, tiny = np.full((90, 60), 128, np.uint8), np.zeros((1, 1), np.uint8)
    for number, view in enumerate((image[:, ::-1], blank, tiny)):  # not contiguous
        found = detector.detect(view)
        n = len(found.responses)
        assert [v.shape for v in found] == [(n, 2), (n,), (n,), (n,), (n, width)]
        assert found.descriptors.dtype == kind
        assert (n > 10) == (number == 0)


# The panorama.


@pytest.mark.parametrize("columns", [200, 256])
def test_a_panorama_has_no_seam(columns: int) -> None:
    """Rolled, it has the same keypoints, rolled: at ±180° as anywhere else."""
    image = texture(SHAPE)
    roll = rotation_about([0, 0, 1], columns / SHAPE[1] * 2 * np.pi)
    left = rotated(detect_on_equirect(image, Detector()), roll)
    right = detect_on_equirect(np.roll(image, columns, axis=1), Detector())
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
    found = detect_on_equirect(blobs(SHAPE, center[None], sigma), Detector())
    found = found.select(angle_deg(found.directions_xyz, center) < 5)
    assert len(np.unique(found.directions_xyz.round(4), axis=0)) == 1
    # OpenCV's default is off by a quarter of a pixel of 0.7°.
    assert angle_deg(found.directions_xyz, center).max() < (0.03 if lat_deg > 0 else 1)
    assert 2 * sigma / DOG / found.sizes_rad.min() == pytest.approx(1, abs=0.25)
    columns = found.equirect_pixels(SHAPE)[:, 0]
    assert ((columns >= -0.5) & (columns <= SHAPE[1] - 0.5)).all()


@pytest.mark.parametrize("name", ["sift", "orb"])
@pytest.mark.parametrize("tangent", [False, True])
def test_a_blank_panorama_has_none_and_colour_is_grey(name: str, tangent: bool) -> None:
    def detect(image: NDArray[np.uint8]) -> SphericalKeypoints:
        grid = TangentGrid(0, 5, dim=29)
        if tangent:
            return detect_on_tangent_images(image, grid, Detector(name), 21)
        return detect_on_equirect(image, Detector(name))

    assert len(detect(np.full((101, 77, 3), 90, np.uint8))) == 0
    image = texture((101, 177))  # odd sizes
    gray, color = detect(image), detect(np.repeat(image[..., None], 3, axis=2))
    assert len(gray) > 30
    np.testing.assert_array_equal(gray.directions_xyz, color.directions_xyz)
    np.testing.assert_array_equal(gray.descriptors, color.descriptors)


# Tangent images.


# Other base levels than 0 are in tests/slow/keypoints.


@lru_cache
def found_on_texture(
    base_level: int, *, rotate: bool = False, margin: int = 16, name: str = "sift"
) -> SphericalKeypoints:
    image = texture(SHAPE, ROTATION if rotate else None)
    return detect_on_tangent_images(image, TangentGrid(base_level, LEVEL), Detector(name), margin)


@pytest.mark.parametrize("base_level", [0])
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


@pytest.mark.parametrize("base_level", [0, 2])
def test_the_gnomonic_jacobian_is_the_derivative(base_level: int) -> None:
    grid = TangentGrid(base_level, 6, rotation=ROTATION)
    rng = np.random.default_rng(0)
    for face in (0, grid.num_images - 1):
        pixels = rng.uniform(-0.5, grid.dim - 0.5, (50, 2))

        def ray(pixels_xy: NDArray[np.float64], face: int = face) -> NDArray[np.float64]:
            homogeneous = np.column_stack([pixels_xy, np.ones(len(pixels_xy))])
            rays = unit(homogeneous @ np.linalg.inv(grid.camera_matrix).T)
            return np.asarray(rays @ grid.world_from_camera[face].T)

        steps = 1e-5 * np.eye(2)
        numeric = [(ray(pixels + step) - ray(pixels - step)) / 2e-5 for step in steps]
        jacobian = gnomonic_jacobian(ray(pixels), grid, face)
        np.testing.assert_allclose(jacobian, np.stack(numeric, axis=-1), atol=1e-9)


@pytest.mark.parametrize("base_level", [0])
def test_every_keypoint_is_owned_by_its_image_and_there_once(base_level: int) -> None:
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
    np.testing.assert_allclose(inner, 0, atol=1e-12)


def spots(grid: TangentGrid) -> NDArray[np.float64]:
    """Half a pixel beside corners of cells, two of them the poles, and two on the seam."""
    corners = unit(icosphere(grid.base_level)[0][[0, 1, 4, 9, 6, -1]])
    inwards = unit(grid.centers_xyz[grid.owners(corners)] - corners)
    seam = lonlat_to_xyz(np.deg2rad([[180.0, 12.0], [-179.9, 40.0]]))
    return np.concatenate([unit(corners + 0.5 * grid.pitch * inwards), seam])


@pytest.mark.parametrize("base_level", [0])
def test_a_blob_is_found_at_its_place_and_by_its_owner_alone(base_level: int) -> None:
    """Of several widths: SIFT passes over some of those that lie between two of its scales."""
    grid = TangentGrid(base_level, LEVEL)
    centers = spots(grid)
    owners = grid.owners(centers)
    seen = np.zeros(len(centers), int)
    for sigma_deg in (1.6, 1.85, 2.1, 2.4):
        sigma = np.deg2rad(sigma_deg)
        found = detect_on_tangent_images(blobs(SHAPE, centers, sigma), grid, Detector(), 16)
        distance = angle_deg(found.directions_xyz[:, None], centers)
        near = distance.min(axis=1) < 3  # what is farther off is dark and between them
        found, distance = found.select(near), distance[near]
        nearest = distance.argmin(axis=1)
        assert distance.min(axis=1).max() < 0.15  # of a pixel of 1°
        np.testing.assert_array_equal(found.images, owners[nearest])
        np.testing.assert_allclose(found.sizes_rad, 2 * sigma / DOG, rtol=0.06)
        seen += np.isin(np.arange(len(centers)), nearest)
    assert seen.min() >= 1
    assert seen.mean() > 2.5
