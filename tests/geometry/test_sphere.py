"""Directions, equirectangular pixels, rotations and poses, against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    PanoramaPose,
    TangentGrid,
    equirect_directions,
    equirect_latitudes,
    equirect_solid_angles,
    equirect_to_lonlat,
    lonlat_to_equirect,
    lonlat_to_xyz,
    random_rotation,
    to_right_handed,
    xyz_to_lonlat,
)
from tangent_train.geometry.sphere import gnomonic_points_xyz, tangent_axes

longitudes = st.floats(-math.pi, math.pi)
latitudes = st.floats(-math.pi / 2, math.pi / 2)


@pytest.mark.parametrize(
    ("lon_deg", "lat_deg", "xyz"),
    [
        (0, 0, (1, 0, 0)),
        (90, 0, (0, 1, 0)),
        (-90, 0, (0, -1, 0)),
        (180, 0, (-1, 0, 0)),
        (-180, 0, (-1, 0, 0)),
        (0, 90, (0, 0, 1)),
        (77, -90, (0, 0, -1)),
        (45, 30, (math.sqrt(3 / 8), math.sqrt(3 / 8), 0.5)),
    ],
)
def test_axes_have_the_documented_directions(
    lon_deg: float, lat_deg: float, xyz: tuple[float, float, float]
) -> None:
    np.testing.assert_allclose(lonlat_to_xyz(np.radians([lon_deg, lat_deg])), xyz, atol=1e-15)


@given(longitudes, latitudes)
def test_lonlat_is_recovered_from_xyz(lon: float, lat: float) -> None:
    xyz = lonlat_to_xyz([lon, lat])
    lon_back, lat_back = xyz_to_lonlat(7 * xyz)
    assert np.linalg.norm(xyz) == pytest.approx(1, abs=1e-14)
    assert lat_back == pytest.approx(lat, abs=1e-12)
    # Near a pole longitude is imprecise: compare the distance on the sphere.
    assert math.cos(lat) * math.sin((lon_back - lon) / 2) == pytest.approx(0, abs=1e-12)
    assert -math.pi <= lon_back <= math.pi


def test_random_rotations_are_proper_and_uniform() -> None:
    rng = np.random.default_rng(3)
    rotations = np.stack([random_rotation(rng) for _ in range(4000)])
    unity = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(unity, np.broadcast_to(np.eye(3), unity.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    # Uniform on SO(3): E[R] = 0, E[R_ij²] = 1/3, and the angle ω has density (1 − cos ω)/π.
    np.testing.assert_allclose(rotations.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose((rotations**2).mean(axis=0), 1 / 3, atol=0.03)
    angle = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angle.mean() == pytest.approx(math.pi / 2 + 2 / math.pi, abs=0.05)


@pytest.mark.parametrize("rotation", [2 * np.eye(3), np.diag([1.0, 1, -1]), np.eye(3) * np.nan])
def test_impossible_rotations_are_refused(rotation: NDArray[np.float64]) -> None:
    with pytest.raises(SettingError, match=r"rotation: found .* of determinant"):
        TangentGrid(0, 4).with_rotation(rotation)


Shape = tuple[int, int]
SHAPES = [(1, 1), (2, 4), (50, 100), (63, 126), (7, 9)]


@pytest.mark.parametrize(
    ("pixel", "lonlat_deg"),
    [
        ((0, 0), (-135, 45)),
        ((3, 1), (135, -45)),
        ((1.5, 0.5), (0, 0)),
        ((-0.5, -0.5), (-180, 90)),
        ((3.5, 1.5), (180, -90)),
    ],
)
def test_pixels_of_a_panorama_of_two_rows_have_known_positions(
    pixel: tuple[float, float], lonlat_deg: tuple[float, float]
) -> None:
    lonlat = np.radians(lonlat_deg)
    np.testing.assert_allclose(equirect_to_lonlat(pixel, (2, 4)), lonlat, atol=1e-15)
    np.testing.assert_allclose(lonlat_to_equirect(lonlat, (2, 4)), pixel, atol=1e-15)


@pytest.mark.parametrize("shape", SHAPES)
def test_directions_are_those_of_the_pixel_centers(shape: Shape) -> None:
    height, width = shape
    rows, columns = np.mgrid[:height, :width]
    pixels = np.stack([columns, rows], axis=-1)
    lonlat = equirect_to_lonlat(pixels, shape)
    np.testing.assert_allclose(lonlat_to_equirect(lonlat, shape), pixels, atol=1e-12)
    directions = equirect_directions(shape)
    assert directions.shape == (*shape, 3)
    np.testing.assert_allclose(directions, lonlat_to_xyz(lonlat), atol=1e-14)
    np.testing.assert_allclose(equirect_latitudes(height), lonlat[:, 0, 1], atol=1e-15)


def test_solid_angle_of_a_row_is_the_integral_of_cos_latitude() -> None:
    height, width = 9, 16
    for row, angle in enumerate(equirect_solid_angles((height, width))):
        top = math.pi / 2 - row / height * math.pi
        area, _ = quad(math.cos, top - math.pi / height, top)
        assert angle == pytest.approx(area * 2 * math.pi / width, rel=1e-12)


def test_points_are_the_pixels_of_tangent_images() -> None:
    grid = TangentGrid(base_level=1, level=4)
    points = gnomonic_points_xyz(grid.centers_xyz, grid.dim, grid.pitch)
    np.testing.assert_allclose(points, grid.directions().reshape(points.shape), atol=1e-12)


@pytest.mark.parametrize("pole", [1.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, -0.0, 1e-17, -1e-17])
def test_poles_have_longitude_zero(pole: float, noise: float) -> None:
    axes = tangent_axes([noise, -noise, 2 * pole])
    np.testing.assert_allclose(axes, np.array([[0, 1, 0], [-pole, 0, 0], [0, 0, pole]]), atol=1e-12)
    points = gnomonic_points_xyz([[noise, -noise, pole]], 3, 0.1)[0]
    np.testing.assert_allclose(points[4], [0, 0, pole], atol=1e-12)
    assert len(np.unique(points.round(6), axis=0)) == 9


def posed(seed: int, mirrored: bool) -> PanoramaPose:
    rng = np.random.default_rng(seed)
    rotation = random_rotation(rng)
    return PanoramaPose(to_right_handed(rotation) if mirrored else rotation, rng.normal(size=3) * 4)


def test_a_panorama_in_a_right_handed_room() -> None:
    # It looks along the room's y axis, 1.5 m above the floor and lying on a side: right is up.
    pose = PanoramaPose([[0, 0, -1], [1, 0, 0], [0, 1, 0]], (3, 4, 1.5))
    ahead, right, up = np.eye(3)
    np.testing.assert_allclose(pose.points_m(ahead, 2), (3, 6, 1.5), atol=1e-15)
    np.testing.assert_allclose(pose.points_m(right, 2), (3, 4, 3.5), atol=1e-15)
    np.testing.assert_allclose(pose.points_m(up, 2), (1, 4, 1.5), atol=1e-15)
    direction, distance = pose.project((3, 4 - 1, 1.5 + np.sqrt(3)))
    np.testing.assert_allclose(np.degrees(xyz_to_lonlat(direction)), (120, 0), atol=1e-12)
    assert distance == pytest.approx(2)


@pytest.mark.parametrize("mirrored", [False, True])
def test_relative_poses_are_those_of_homogeneous_matrices(mirrored: bool) -> None:
    left, right = posed(4, mirrored), posed(5, mirrored)

    def homogeneous(pose: PanoramaPose) -> NDArray[np.float64]:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = pose.world_from_panorama, pose.location_m
        return matrix

    expected = np.linalg.inv(homogeneous(right)) @ homogeneous(left)
    rotation, shift_m = right.relative_to(left)
    np.testing.assert_allclose(rotation, expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(shift_m, expected[:3, 3], atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
