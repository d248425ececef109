"""Pooling and enlarging against torch's own, directions against the geometry of the grid."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional

from models.sphere_tokens import add_tokens, lone_rays, to_tokens, token_directions
from tangent_train.geometry import (
    TangentGrid,
    camera_matrix_from_fov,
    perspective_directions,
    random_rotation,
)
from tests.models.sphere_networks import tangent_rays

SIZES = [(3, 3), (4, 4), (1, 7), (5, 9), (12, 2), (16, 13)]


@pytest.mark.parametrize("most", [1, 2, 4])
@pytest.mark.parametrize("size", SIZES)
def test_pooling_is_adaptive_pooling(size: tuple[int, int], most: int) -> None:
    features = torch.randn(2, 3, *size, dtype=torch.float64)
    rows, columns = (min(side, most) for side in size)
    tokens = to_tokens(features, most)
    torch.testing.assert_close(tokens, functional.adaptive_avg_pool2d(features, (rows, columns)))
    if max(size) <= most:
        assert torch.equal(tokens, features)


@pytest.mark.parametrize("most", [1, 2, 4])
@pytest.mark.parametrize("size", SIZES)
def test_enlarging_is_bilinear_interpolation(size: tuple[int, int], most: int) -> None:
    features = torch.randn(2, 3, *size, dtype=torch.float64)
    tokens = torch.randn(2, 3, *(min(side, most) for side in size), dtype=torch.float64)
    enlarged = functional.interpolate(tokens, size, mode="bilinear")
    torch.testing.assert_close(
        add_tokens(features, tokens), features + enlarged, rtol=1e-6, atol=1e-6
    )


def test_features_keep_their_dtype_and_layout() -> None:
    features = torch.randn(2, 8, 6, 6).to(torch.bfloat16, memory_format=torch.channels_last)
    tokens = to_tokens(features, 2)
    torch.testing.assert_close(
        tokens.float(),
        functional.adaptive_avg_pool2d(features.float(), 2),
        atol=0.01,
        rtol=0.01,
    )
    added = add_tokens(features, tokens.float())
    assert added.dtype == torch.bfloat16
    assert added.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(add_tokens(features, torch.zeros(2, 8, 2, 2)), features)


@pytest.mark.parametrize("dim", [None, 15])
def test_tokens_of_single_pixels_look_along_the_grid(dim: int | None) -> None:
    rotation = random_rotation(np.random.default_rng(0))
    grid = TangentGrid(0, 4, dim, rotation)
    found = token_directions(tangent_rays(grid)[None], grid.dim, grid.dim)
    expected = torch.tensor(grid.directions()).movedim(-1, 1)[None]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)


def test_tokens_of_several_pixels_look_along_their_middle() -> None:
    grid = TangentGrid(0, 4)
    pixels = torch.tensor(grid.directions()).movedim(-1, 1)
    planar = pixels / (pixels * torch.tensor(grid.centers_xyz)[..., None, None]).sum(
        1, keepdim=True
    )
    found = token_directions(tangent_rays(grid)[None], 4, 2)
    middle = functional.normalize(functional.adaptive_avg_pool2d(planar, (4, 2)), dim=1)
    torch.testing.assert_close(found[0], middle, rtol=0, atol=1e-12)


def test_a_negated_column_mirrors() -> None:
    rays = tangent_rays(TangentGrid(0, 4))[None]
    mirrored = rays * torch.tensor([-1.0, 1.0, 1.0])
    expected = token_directions(rays, 3, 4).flip(-1)
    torch.testing.assert_close(token_directions(mirrored, 3, 4), expected)


@pytest.mark.parametrize("size", [(6, 6), (5, 8)])
def test_lone_images_look_ahead_as_a_level_camera(size: tuple[int, int]) -> None:
    rays = lone_rays(torch.zeros(2, 3, *size, dtype=torch.float64), 50.0)
    assert rays.shape == (2, 1, 3, 3)
    found = token_directions(rays, *size)[1, 0].movedim(0, -1)
    camera = perspective_directions(camera_matrix_from_fov(50.0, size), size)
    x, y, z = np.moveaxis(camera, -1, 0)
    torch.testing.assert_close(found, torch.tensor(np.stack([z, x, -y], -1)))
