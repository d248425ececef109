"""Images of another size see what the original ones see."""

from __future__ import annotations

import numpy as np
import pytest

from tangent_train.geometry import CubeGrid, PinholeGrid, TangentGrid, rotation_about

ROTATION, OTHER = rotation_about((1, 2, 3), 0.4), rotation_about((0, 1, 0), 1.1)
GRIDS: list[PinholeGrid] = [
    CubeGrid(8, ROTATION),
    TangentGrid(1, 5),
    TangentGrid(0, 4, 20, ROTATION),
]


@pytest.mark.parametrize("original", GRIDS)
@pytest.mark.parametrize("dim", [2, 7, 33])
def test_only_the_pixels_are_others(original: PinholeGrid, dim: int) -> None:
    grid = original.resized(dim)
    assert grid.dim == dim
    assert grid.dim * grid.pitch == pytest.approx(original.dim * original.pitch, rel=1e-15)
    assert grid.num_images == original.num_images
    assert grid.overlapping is original.overlapping
    np.testing.assert_array_equal(grid.rotation, original.rotation)
    np.testing.assert_array_equal(grid.neighbors, original.neighbors)
    np.testing.assert_array_equal(grid.world_from_camera, original.world_from_camera)
    assert grid.with_rotation(OTHER) == original.with_rotation(OTHER).resized(dim)
    # The outer edges agree: the middle of d pixels is (d − 1)/2.
    edges = original.project(grid.directions([3])[0, 0, 0], 3)
    np.testing.assert_allclose((edges + 0.5) * dim / original.dim, 0.5, atol=1e-9)
