"""Cube maps: edges between faces, and poles; the rest is tested with tangent images."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tangent_train.geometry import CubeGrid, equirect_directions
from tangent_train.rendering import tangent_to_equirect, tangent_to_labels


@pytest.mark.parametrize("shape", [(6, 12), (33, 67)])
@pytest.mark.parametrize("dim", [2, 9, 16])
def test_pixels_up_to_the_edge_only_use_their_owner(dim: int, shape: tuple[int, int]) -> None:
    """Beyond the outermost pixel centers, pixels are repeated: no mixing, no NaN."""
    grid = CubeGrid(dim)
    images = torch.arange(1.0, 7.0)[:, None, None, None].expand(6, 1, dim, dim)
    panorama = tangent_to_equirect(images, grid, shape)[0].numpy()
    owner = np.rint(panorama).astype(int) - 1
    np.testing.assert_allclose(panorama, owner + 1, atol=1e-5)
    scores = torch.eye(6)[:, :, None, None].expand(6, 6, dim, dim)
    np.testing.assert_array_equal(tangent_to_labels(scores, grid, shape), owner)
    x, y, z = np.moveaxis(equirect_directions(shape), -1, 0)
    coordinates = np.stack([x, y, -x, -y, z, -z])
    owned = np.take_along_axis(coordinates, owner[None], axis=0)[0]
    np.testing.assert_allclose(owned, coordinates.max(axis=0), atol=1e-12)
