"""Who owns a direction, how far owned cells reach, and the walk to the owner."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import SphericalVoronoi

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, rotation_about, xyz_to_lonlat
from tests.geometry.directions import random_directions


@lru_cache
def voronoi_extent(base_level: int) -> float:
    """Largest |x| or |y| of a cell corner on its own tangent plane, by textbook projection."""
    centers = TangentGrid(base_level, base_level + 6).centers_xyz
    voronoi = SphericalVoronoi(centers, threshold=1e-9)
    cell = np.repeat(np.arange(len(centers)), [len(region) for region in voronoi.regions])
    corners = voronoi.vertices[np.concatenate(voronoi.regions).astype(int)]
    (lon_0, lat_0), (lon, lat) = xyz_to_lonlat(centers)[cell].T, xyz_to_lonlat(corners).T
    cos_c = np.sin(lat_0) * np.sin(lat) + np.cos(lat_0) * np.cos(lat) * np.cos(lon - lon_0)
    x = np.cos(lat) * np.sin(lon - lon_0) / cos_c
    y = (np.cos(lat_0) * np.sin(lat) - np.sin(lat_0) * np.cos(lat) * np.cos(lon - lon_0)) / cos_c
    return float(np.abs([x, y]).max())


@pytest.mark.parametrize("base_level", range(5))
@pytest.mark.parametrize("finer", [3, 4, 6])
def test_least_dim_covers_the_voronoi_cells_exactly(base_level: int, finer: int) -> None:
    level = base_level + finer
    pitch = TangentGrid(base_level, level).pitch
    least = math.ceil(2 * voronoi_extent(base_level) / pitch) + 1
    with pytest.raises(SettingError, match=f"dim: found {least - 1}; expected at least {least} "):
        TangentGrid(base_level, level, least - 1)
    assert TangentGrid(base_level, level, least).half_extent >= voronoi_extent(base_level)
    assert TangentGrid.least_dim(base_level, level) == least


@pytest.mark.parametrize("rotation", [None, rotation_about((1, 1, 0), 2.0)])
def test_owner_has_the_nearest_centre(rotation: NDArray[np.float64] | None) -> None:
    grid = TangentGrid(1, 5, rotation=rotation)
    directions = random_directions(600)
    angles = np.arccos(np.clip(directions @ grid.centers_xyz.T, -1, 1))
    expected = angles.argmin(axis=1)
    np.testing.assert_array_equal(grid.owners(directions), expected)
    # Vectors of any length and shape.
    np.testing.assert_array_equal(
        grid.owners(3 * directions.reshape(20, 30, 3)), expected.reshape(20, 30)
    )
