"""Directions, longitude and latitude, rotations, against closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    CubeGrid,
    TangentGrid,
    checked_rotation,
    lonlat_to_xyz,
    random_rotation,
    xyz_to_lonlat,
)

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


@pytest.mark.parametrize(
    "rotation", [np.eye(2), 2 * np.eye(3), np.diag([1.0, 1, -1]), np.full((3, 3), np.nan)]
)
@pytest.mark.parametrize(
    "take", [checked_rotation, CubeGrid(4).with_rotation, TangentGrid(0, 4).with_rotation]
)
def test_impossible_rotations_are_refused(take: Any, rotation: NDArray[np.float64]) -> None:
    with pytest.raises(SettingError, match=r"rotation: found .* of determinant"):
        take(rotation)
