"""Tangent axes and gnomonic taps against published formulas and tangent images."""

from __future__ import annotations

import numpy as np
import pytest

from tangent_train.geometry import TangentGrid, equirect_directions, lonlat_to_xyz
from tangent_train.geometry.gnomonic_taps import gnomonic_taps_xyz, tangent_axes


def test_taps_are_the_pixels_of_tangent_images() -> None:
    grid = TangentGrid(base_level=1, level=4)
    taps = gnomonic_taps_xyz(grid.centers_xyz, grid.dim, grid.pitch)
    np.testing.assert_allclose(taps, grid.directions().reshape(taps.shape), atol=1e-12)


@pytest.mark.parametrize("kernel", [(3, 3), (2, 5)])
def test_taps_follow_the_inverse_gnomonic_projection_across_poles_and_seam(
    kernel: tuple[int, int],
) -> None:
    shape = (8, 16)  # taps of the first row cross the pole, those of the first column the seam
    pitch = np.tan(2 * np.pi / shape[1])
    directions = equirect_directions(shape).reshape(-1, 3)
    lon, lat = np.arctan2(directions[:, 1], directions[:, 0]), np.arcsin(directions[:, 2])
    expected = []
    for row in range(kernel[0]):
        for column in range(kernel[1]):
            x = (column - (kernel[1] - 1) / 2) * pitch
            y = ((kernel[0] - 1) / 2 - row) * pitch
            rho, nu = np.hypot(x, y), np.arctan(np.hypot(x, y))
            tap_lat = np.arcsin(
                np.cos(nu) * np.sin(lat) + (y / rho if rho else 0.0) * np.sin(nu) * np.cos(lat)
            )
            across = rho * np.cos(lat) * np.cos(nu) - y * np.sin(lat) * np.sin(nu)
            expected.append(
                lonlat_to_xyz(
                    np.stack([lon + np.arctan2(x * np.sin(nu), across), tap_lat], axis=-1)
                )
            )
    taps = gnomonic_taps_xyz(directions, kernel, pitch)
    np.testing.assert_allclose(taps, np.stack(expected, axis=1), atol=1e-12)


@pytest.mark.parametrize("pole", [1.0, -1.0])
@pytest.mark.parametrize("noise", [0.0, -0.0, 1e-17, -1e-17])
def test_poles_have_longitude_zero(pole: float, noise: float) -> None:
    axes = tangent_axes([noise, -noise, 2 * pole])
    np.testing.assert_allclose(axes, np.array([[0, 1, 0], [-pole, 0, 0], [0, 0, pole]]), atol=1e-12)
    taps = gnomonic_taps_xyz([[noise, -noise, pole]], 3, 0.1)[0]
    np.testing.assert_allclose(taps[4], [0, 0, pole], atol=1e-12)
    assert len(np.unique(taps.round(6), axis=0)) == 9
