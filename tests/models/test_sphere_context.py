"""A network with context: what it was before training, and who sees whom after it."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from models import SphereContext
from models.sphere_context import token_directions
from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, random_rotation
from tests.models.sphere_networks import (
    ATTENTION,
    STAGE,
    awake,
    small_context,
    small_unet,
    sphere_rays,
    tangent_rays,
)


@pytest.mark.parametrize("size", [(16, 16), (4, 20)])
def test_before_training_it_computes_what_the_network_computes(size: tuple[int, int]) -> None:
    network = small_unet()
    context = SphereContext(copy.deepcopy(network), STAGE, ATTENTION, in_channels=3)
    images = torch.randn(6, 3, *size)
    for module in (network.eval(), context.eval()):
        module.requires_grad_(False)
    expected = network(images)
    assert torch.equal(context(images), expected)
    assert torch.equal(context(images, sphere_rays(3, 2)), expected)
    assert torch.equal(context(images, sphere_rays(3, 2), 4), expected)


class Averaging(nn.Module):
    """A mixer that adds the mean of all images' tokens, and what they look along."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(channels))

    def forward(self, tokens: Tensor, directions: Tensor) -> Tensor:
        mean = tokens.mean(dim=(1, 3, 4), keepdim=True) + directions.sum(2, keepdim=True)
        return mean.expand_as(tokens) * self.scale[:, None, None]


def test_features_get_what_the_mixer_says() -> None:
    """At the stage: here all that the network does."""
    network = nn.Sequential(nn.Conv2d(3, 4, 3, padding=1))
    context = SphereContext(network, "0", Averaging, in_channels=3, tokens=2)
    images, rays = torch.randn(3, 3, 12, 10), sphere_rays(3)
    features = network[0](images)
    tokens = functional.adaptive_avg_pool2d(features, 2)[None]
    mixed = context.mixer(tokens, token_directions(rays, 2, 2))[0]
    expected = features + functional.interpolate(mixed, (12, 10), mode="bilinear")
    torch.testing.assert_close(context(images, rays), expected)
    torch.testing.assert_close(context(images, rays, 2), expected)


def test_an_image_alone_or_without_rays_has_no_context() -> None:
    context = small_context().eval()
    images, rays = torch.randn(5, 3, 16, 16), sphere_rays(5)
    with torch.no_grad():
        expected = context.network(images)
        assert torch.equal(context(images), expected)
        assert torch.equal(context(images, rays.reshape(5, 1, 3, 3)), expected)
        assert not torch.allclose(context(images, rays), expected, rtol=0, atol=1e-5)


def test_mirrored_images_give_mirrored_scores() -> None:
    """With a network that has no left and right itself."""
    network = nn.Sequential(nn.Conv2d(3, 8, 1), nn.AvgPool2d(2), nn.Conv2d(8, 2, 1))
    context = SphereContext(network, "1", ATTENTION, in_channels=3, tokens=3).eval()
    awake(context.mixer)
    images, rays = torch.randn(4, 3, 12, 12), sphere_rays(4)
    mirrored = rays * torch.tensor([-1.0, 1.0, 1.0])
    with torch.no_grad():
        scores = context(images, rays)
        torch.testing.assert_close(context(images.flip(-1), mirrored).flip(-1), scores)
        assert not torch.allclose(context(images.flip(-1), rays).flip(-1), scores, atol=1e-3)


@pytest.mark.parametrize("size", [(15, 15), (5, 3)])
def test_tokens_look_along_the_middle_of_their_pixels(size: tuple[int, int]) -> None:
    grid = TangentGrid(0, 4, 15, random_rotation(np.random.default_rng(0)))
    pixels = torch.tensor(grid.directions()).movedim(-1, 1)
    along = (pixels * torch.tensor(grid.centers_xyz)[..., None, None]).sum(1, keepdim=True)
    found = token_directions(tangent_rays(grid)[None], *size)
    middle = functional.normalize(functional.adaptive_avg_pool2d(pixels / along, size), dim=1)
    torch.testing.assert_close(found[0], middle, rtol=0, atol=1e-12)


def test_copies_are_on_their_own_and_the_network_by_itself_is_as_before() -> None:
    network, images, rays = small_unet().eval(), torch.randn(2, 3, 16, 16), sphere_rays(2)
    plain = network(images)
    context = small_context(network).eval()
    expected = context(images, rays)
    assert not torch.allclose(expected, plain, atol=1e-3)
    assert torch.equal(network(images), plain)
    with pytest.raises(SettingError, match="multiples of 4"):
        context(torch.zeros(2, 3, 6, 6), rays)
    assert torch.equal(network(images), plain), "nothing is left behind by an error"
    other = copy.deepcopy(context)
    awake(context)
    torch.testing.assert_close(other(images, rays), expected)
