"""Equirectangular pixels: the convention of `tangent_train.geometry`, the seam and the poles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    equirect_directions,
    equirect_latitudes,
    equirect_shape,
    equirect_solid_angles,
    equirect_to_lonlat,
    lonlat_to_equirect,
    lonlat_to_xyz,
)

Shape = tuple[int, int]
SHAPES = [(1, 1), (2, 4), (50, 100), (63, 126), (7, 9)]


def test_levels_begin_with_two_rows() -> None:
    assert equirect_shape(0) == (2, 4)
    with pytest.raises(SettingError, match="level: found -1; expected 0 or more"):
        equirect_shape(-1)


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
