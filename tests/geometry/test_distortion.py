"""Closed forms of map distortion, against differentiation and numerical integration."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad

from tangent_train.geometry import lonlat_to_xyz
from tangent_train.geometry.distortion import (
    angular_distortion,
    equirect_mean_angular_distortion,
    equirect_mean_area_deviation,
    equirect_scales,
    gnomonic_scales,
    principal_scales,
)


def sphere_from_gnomonic(x: float, y: float) -> NDArray[np.float64]:
    point = np.array([x, y, 1.0])
    return point / np.linalg.norm(point)


def sphere_from_equirect(lon: float, lat: float) -> NDArray[np.float64]:
    return lonlat_to_xyz([lon, lat])


def derivatives(function: object, x: float, y: float, step: float = 1e-5) -> NDArray[np.float64]:
    assert callable(function)
    right = (function(x + step, y) - function(x - step, y)) / (2 * step)
    down = (function(x, y + step) - function(x, y - step)) / (2 * step)
    return np.stack([right, down], axis=-1)


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (0.4, -0.3), (1.0, 1.0), (-2.0, 0.1)])
def test_gnomonic_scales_are_the_singular_values(x: float, y: float) -> None:
    jacobian = derivatives(sphere_from_gnomonic, x, y)
    expected = 1 / np.linalg.svd(jacobian, compute_uv=False)[::-1]
    angle = math.atan(math.hypot(x, y))
    np.testing.assert_allclose(gnomonic_scales(angle), expected, rtol=1e-8)
    np.testing.assert_allclose(principal_scales(jacobian), expected, rtol=1e-7)


@pytest.mark.parametrize("lat", [0.0, 0.5, -1.2, 1.55])
def test_equirect_scales_are_the_singular_values(lat: float) -> None:
    jacobian = derivatives(sphere_from_equirect, 3.1, lat)
    expected = 1 / np.linalg.svd(jacobian, compute_uv=False)[::-1]
    np.testing.assert_allclose(equirect_scales(lat), expected, rtol=1e-8)


def test_principal_scales_agree_with_the_svd_on_any_matrix() -> None:
    steps = np.random.default_rng(0).normal(size=(1000, 3, 2))
    expected = 1 / np.linalg.svd(steps, compute_uv=False)
    greatest, least = principal_scales(steps)
    np.testing.assert_allclose(greatest, expected[:, 1], rtol=1e-8)
    np.testing.assert_allclose(least, expected[:, 0], rtol=1e-8)


def test_angular_distortion_is_the_most_an_angle_changes() -> None:
    """Every angle under the map (x, y) → (a x, b y), tried out."""
    a, b = 2.5, 1.25
    directions = np.linspace(0, np.pi, 721)
    mapped = np.arctan2(b * np.sin(directions), a * np.cos(directions))
    change = (directions[:, None] - directions) - (mapped[:, None] - mapped)
    tried = np.abs(change).max()
    assert float(angular_distortion(a, b)) == pytest.approx(tried, abs=1e-4)
    assert tried <= float(angular_distortion(a, b))


def test_a_zoom_is_no_distortion_of_angles() -> None:
    scales = gnomonic_scales(0.7)
    zoomed = tuple(3.7 * scale for scale in scales)
    assert float(angular_distortion(*zoomed)) == pytest.approx(float(angular_distortion(*scales)))


def test_means_of_the_panorama_agree_with_integrals() -> None:
    def angle(lat: float) -> float:
        return float(angular_distortion(*equirect_scales(lat))) * math.cos(lat)

    def deviation(lat: float) -> float:
        return abs(2 / (math.pi * math.cos(lat)) - 1) * math.cos(lat)

    mean, _ = quad(angle, 0, math.pi / 2, epsabs=1e-12)
    assert equirect_mean_angular_distortion() == pytest.approx(mean, abs=1e-8)
    middle = math.acos(2 / math.pi)
    expected, _ = quad(deviation, 0, math.pi / 2, points=[middle], epsabs=1e-12)
    assert equirect_mean_area_deviation() == pytest.approx(expected, abs=1e-10)
