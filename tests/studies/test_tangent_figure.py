"""The figure shows each image once, from north to south."""

from __future__ import annotations

import numpy as np
import pytest

from studies.tangent_figure import tangent_figure
from tangent_train.geometry import TangentGrid, equirect_directions, random_rotation

TOP = 800


@pytest.mark.parametrize("base_level", [0, 1, 3])
def test_images_are_at_their_positions(base_level: int) -> None:
    """Colors encode directions, which identify the image at each position."""
    rotation = random_rotation(np.random.default_rng(1)) if base_level == 1 else None
    grid = TangentGrid(base_level, base_level + 4, rotation=rotation)
    panorama = np.rint((equirect_directions((64, 128)) + 1) * 127.5).astype(np.uint8)
    page = tangent_figure(panorama, grid)
    for row, column in ((150, 240), (430, 650), (650, 1400)):
        there = panorama[row * 64 // 800, column * 128 // 1600]
        shown = np.median(page[row - 8 : row + 9, column - 8 : column + 9], axis=(0, 1))
        assert np.abs(shown - there).max() < 15
    columns = 10 * 2**base_level
    step = 1600 // columns
    corners = grid.resized((step - 4, step - 4)).directions()[:, 2, 2]
    faces = []
    for place in range(grid.num_images):
        row, column = divmod(place, columns)
        direction = page[TOP + row * step + 4 + 2, column * step + 2 + 2] / 127.5 - 1
        faces.append(int((corners @ direction).argmax()))
    assert sorted(faces) == list(range(grid.num_images))
    z = grid.with_rotation(None).centers_xyz[faces, 2].reshape(-1, columns)
    assert (z[:-1].min(axis=1) >= z[1:].max(axis=1) - 1e-6).all()
