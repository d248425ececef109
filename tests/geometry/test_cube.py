"""Faces of a cube: positions of corners, common edges, owners."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import CubeGrid, rotation_about
from tests.geometry.directions import random_directions

ROTATION = rotation_about((1, 2, -3), 1.1)
FRONT, RIGHT, BACK, LEFT, UP, DOWN = range(6)

# Top left, top right, bottom left, bottom right, as seen from inside: y is right, z is up.
CORNERS = {
    FRONT: [(1, -1, 1), (1, 1, 1), (1, -1, -1), (1, 1, -1)],
    RIGHT: [(1, 1, 1), (-1, 1, 1), (1, 1, -1), (-1, 1, -1)],
    BACK: [(-1, 1, 1), (-1, -1, 1), (-1, 1, -1), (-1, -1, -1)],
    LEFT: [(-1, -1, 1), (1, -1, 1), (-1, -1, -1), (1, -1, -1)],
    UP: [(-1, -1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, 1)],
    DOWN: [(1, -1, -1), (1, 1, -1), (-1, -1, -1), (-1, 1, -1)],
}


@pytest.mark.parametrize("dim", [2, 5, 16])
@pytest.mark.parametrize("face", CORNERS)
def test_the_outer_corners_of_the_pixels_are_the_corners_of_the_cube(face: int, dim: int) -> None:
    grid = CubeGrid(dim)
    first, last = -0.5, dim - 0.5
    expected = [(first, first), (last, first), (first, last), (last, last)]  # column, row
    np.testing.assert_allclose(grid.project(CORNERS[face], face), expected, atol=1e-12)


@pytest.mark.parametrize("rotation", [None, ROTATION])
def test_only_the_owner_contains_a_direction(
    rotation: NDArray[np.float64] | None,
) -> None:
    grid = CubeGrid(9, rotation)
    directions = random_directions(5000)
    positions = grid.project(directions, np.arange(6)[:, None])
    seen = (np.abs(positions - 4) < 4.5).all(axis=-1)
    np.testing.assert_array_equal(seen.sum(axis=0), 1)
    np.testing.assert_array_equal(grid.owners(directions), seen.argmax(axis=0))
    # The face of the largest coordinate, by hand.
    x, y, z = (directions @ grid.rotation if grid.rotation is not None else directions).T
    largest = np.stack([x, y, -x, -y, z, -z]).argmax(axis=0)
    np.testing.assert_array_equal(grid.owners(directions), largest)


def test_a_margin_shows_what_is_beyond_the_face() -> None:
    plain, wide = CubeGrid(8, ROTATION), CubeGrid(14, ROTATION, margin=3)
    np.testing.assert_allclose(
        wide.directions()[:, 3:-3, 3:-3], plain.directions(), rtol=0, atol=1e-14
    )
    assert (wide.pitch, wide.is_overlapping, plain.is_overlapping) == (plain.pitch, True, False)
    directions = random_directions(500)
    np.testing.assert_array_equal(wide.owners(directions), plain.owners(directions))
    for margin in (-1, 7, 0.5):
        with pytest.raises(SettingError, match=r"margin: found|dim: found 14; expected .* 16 or"):
            CubeGrid(14, margin=margin)  # type: ignore[arg-type]
