"""Tangent axes and gnomonic points against tangent images; other tests have their formulas."""

from __future__ import annotations

import numpy as np
import pytest

from tangent_train.geometry import TangentGrid
from tangent_train.geometry.gnomonic_points import gnomonic_points_xyz, tangent_axes


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
