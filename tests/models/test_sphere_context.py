"""A network with context: what it was before training, and who sees whom after it."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from collections import OrderedDict
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from models import FCNResNet, SphereContext, UNet
from models.sphere_tokens import lone_rays, token_directions
from tangent_train.errors import SettingError
from tangent_train.geometry import random_rotation
from tests.models.sphere_networks import (
    ATTENTION,
    STAGE,
    awake,
    small_context,
    small_unet,
    sphere_rays,
)


class _Named(nn.Module):
    """Results as torchvision's networks have them."""

    def __init__(self) -> None:
        super().__init__()
        self.downs = nn.ModuleList([nn.Identity(), nn.Conv2d(3, 8, 4, stride=4)])
        self.head = nn.Conv2d(8, 2, 1)

    def forward(self, images: Tensor) -> OrderedDict[str, Tensor]:
        features = self.downs[1](images)
        return OrderedDict(out=self.head(features), aux=features.mean((2, 3)))


@pytest.mark.parametrize("size", [(16, 16), (4, 20), (12, 28)])
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


def test_features_get_what_the_mixer_says() -> None:
    context, images = small_context().double().eval(), torch.randn(3, 3, 24, 20).double()
    rays = sphere_rays(3).double()
    seen: dict[str, Tensor] = {}
    stage, last, following = map(context.network.get_submodule, (STAGE, f"{STAGE}.1", "ups.0"))
    handles = [
        stage.register_forward_hook(lambda _m, _i, result: seen.update(after=result)),
        last.register_forward_hook(lambda _m, _i, result: seen.update(before=result)),
        following.register_forward_pre_hook(lambda _m, inputs: seen.update(next=inputs[0])),
    ]
    with torch.no_grad():
        context(images, rays)
        tokens = functional.adaptive_avg_pool2d(seen["before"], 2)[None]
        mixed = context.mixer(tokens, token_directions(rays, 2, 2))[0]
        enlarged = functional.interpolate(mixed, seen["before"].shape[-2:], mode="bilinear")
    assert len(handles) == 3
    torch.testing.assert_close(seen["after"], seen["before"] + enlarged)
    assert seen["next"] is seen["after"]


def test_turning_the_sphere_changes_nothing_and_looking_elsewhere_does() -> None:
    context, images, rays = (
        small_context().double().eval(),
        torch.randn(5, 3, 16, 16, dtype=torch.float64),
        sphere_rays(5).double(),
    )
    turn = torch.tensor(random_rotation(np.random.default_rng(5)))
    with torch.no_grad():
        scores = context(images, rays)
        torch.testing.assert_close(context(images, turn @ rays), scores)
        torch.testing.assert_close(context(images, 3 * rays), scores)
        assert not torch.allclose(context(images, rays.flip(1)), scores, rtol=0, atol=1e-5)


def test_images_see_those_of_their_sphere_and_no_others() -> None:
    context, images = (
        small_context().double().eval(),
        torch.randn(8, 3, 16, 16, dtype=torch.float64),
    )
    turn = torch.tensor(random_rotation(np.random.default_rng(6)))
    rays = torch.cat([sphere_rays(4).double(), turn @ sphere_rays(4).double()])
    with torch.no_grad():
        together = context(images, rays)
        for sphere in range(2):
            part = slice(4 * sphere, 4 * sphere + 4)
            alone = context(images[part], rays[sphere : sphere + 1])
            torch.testing.assert_close(alone, together[part])
        order = torch.tensor([2, 0, 3, 1])
        shuffled = context(images[:4][order], rays[:1, order])
        torch.testing.assert_close(shuffled, together[:4][order])
        fewer = context(images[:2], rays[:1, :2])
        assert not torch.allclose(fewer, together[:2], rtol=0, atol=1e-5)


def test_one_image_alone_is_left_as_it_is() -> None:
    context, images = small_context().eval(), torch.randn(3, 3, 16, 16)
    with torch.no_grad():
        expected = context.network(images)
        assert torch.equal(context(images), expected)
        assert torch.equal(context(images, lone_rays(images, 120.0)), expected)
        assert not torch.allclose(context(images, sphere_rays(3)), expected, rtol=0, atol=1e-3)


def test_what_is_trained_on_photos_is_the_same_on_spheres() -> None:
    """The way from photos to panoramas: the context has learned nothing, and changes nothing."""
    torch.manual_seed(0)
    context = SphereContext(small_unet(), STAGE, ATTENTION, in_channels=3)
    optimizer = torch.optim.AdamW(context.parameters(), lr=0.01)
    before = copy.deepcopy(context.network)
    for _ in range(3):
        optimizer.zero_grad()
        context(torch.randn(4, 3, 16, 16)).square().mean().backward()
        optimizer.step()
    images, rays = torch.randn(5, 3, 16, 16), sphere_rays(5)
    with torch.no_grad():
        expected = context.eval().network(images)
        torch.testing.assert_close(context(images, rays), expected, rtol=0, atol=0)
        assert not torch.allclose(before.eval()(images), expected)


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


def test_results_keep_their_names() -> None:
    context = small_context(_Named()).eval()
    images, rays = torch.randn(4, 3, 16, 16), sphere_rays(4)
    with torch.no_grad():
        whole, parts = context(images, rays), context(images, rays, 3)
    assert list(whole) == list(parts) == ["out", "aux"]
    torch.testing.assert_close(dict(whole), dict(parts))


def test_copies_are_on_their_own() -> None:
    context, images, rays = small_context().eval(), torch.randn(2, 3, 16, 16), sphere_rays(2)
    expected = context(images, rays)
    copies: list[Any] = [copy.deepcopy(context), pickle.loads(pickle.dumps(context))]
    assert copy.deepcopy(context).to("meta")(images.to("meta"), rays.to("meta")).shape == (
        2,
        4,
        16,
        16,
    )
    awake(context)
    for other in copies:
        torch.testing.assert_close(other(images, rays), expected)
        assert len(other.network.downs[1]._forward_hooks) == 1


def test_the_network_by_itself_is_as_before() -> None:
    network = small_unet().eval()
    images = torch.randn(2, 3, 16, 16)
    expected = network(images)
    context = small_context(network).eval()
    assert not torch.allclose(context(images, sphere_rays(2)), expected, atol=1e-3)
    assert torch.equal(network(images), expected)
    with pytest.raises(SettingError, match="multiples of 4"):
        context(torch.zeros(2, 3, 6, 6))
    assert torch.equal(network(images), expected), "nothing is left behind by an error"


def test_half_precision() -> None:
    context = small_context().eval()
    images, rays = torch.randn(4, 3, 16, 16), sphere_rays(4)
    with torch.no_grad():
        expected = context(images, rays)
        with torch.autocast("cpu", torch.bfloat16):
            for found in (context(images, rays), context(images, rays, 3)):
                torch.testing.assert_close(found.float(), expected, rtol=0.1, atol=0.1)


def test_fcn_resnet() -> None:
    torch.manual_seed(0)
    network = FCNResNet(3, 5, 50).eval()
    images = torch.randn(3, 3, 40, 40)
    with torch.no_grad():
        expected = network(images)
        context = SphereContext(network, "backbone.layer4", ATTENTION, in_channels=3).eval()
        assert torch.equal(context(images, sphere_rays(3)), expected)
        awake(context.mixer, 0.05)
        scores = context(images, sphere_rays(3))
        torch.testing.assert_close(context(images, sphere_rays(3), 2), scores, rtol=1e-3, atol=1e-4)
    assert not torch.allclose(scores, expected, atol=1e-3)


class Averaging(nn.Module):
    """A mixer that adds the mean of all images' tokens, whatever they see."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.zeros(channels))

    def forward(self, tokens: Tensor, directions: Tensor) -> Tensor:
        mean = tokens.mean(dim=(1, 3, 4), keepdim=True).expand_as(tokens)
        return mean * self.scale[:, None, None]


def test_any_mixer_can_be_chosen() -> None:
    context = SphereContext(small_unet(), STAGE, Averaging, in_channels=3)
    awake(context.mixer)
    context.eval()
    images, rays = torch.randn(4, 3, 16, 16), sphere_rays(4)
    with torch.no_grad():
        scores = context(images, rays)
        torch.testing.assert_close(context(images, rays, 3), scores, rtol=1e-4, atol=1e-5)
    assert scores.shape == (4, 4, 16, 16)


@pytest.mark.slow
def test_it_can_be_compiled() -> None:
    """In a process where arguments are not checked, which compilers cannot see through."""
    program = """
import torch
from tests.models.sphere_networks import small_context, sphere_rays
context, images, rays = small_context(), torch.randn(4, 3, 16, 16), sphere_rays(4)
calls = [(images,), (images, rays), (images, rays, 3)]
expected = [context.eval()(*call) for call in calls]
context.compile(backend="aot_eager")
torch.testing.assert_close([context(*call) for call in calls], expected)
context.train()
for call in calls:
    context.zero_grad()
    context(*call).square().sum().backward()
    assert all(parameter.grad is not None for parameter in context.parameters())
print("the same")
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.stdout == "the same\n", done.stderr


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tokens": 0}, r"network\.tokens: found 0"),
        ({"fov_deg": 180.0}, r"network\.fov_deg: found 180"),
        ({"in_channels": None}, r"network\.channels: found null"),
    ],
)
def test_impossible_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingError, match=message):
        small_context(**settings)


def test_rays_must_fit_and_the_stage_must_run() -> None:
    context = small_context()
    with pytest.raises(SettingError, match=r"rays: found 2 spheres of 3 images; .* of 4 images"):
        context(torch.zeros(4, 3, 16, 16), sphere_rays(3, 2))
    with pytest.raises(SettingError, match="found one with a SphereContext"):
        SphereContext(context, f"network.{STAGE}", ATTENTION, 3, 8)
    unused = UNet(3, 4, (4, 6, 8))
    unused.spare = nn.Conv2d(3, 4, 1)
    lost = SphereContext(unused, "spare", ATTENTION, channels=4)
    for chunk in (None, 1):
        with pytest.raises(SettingError, match="found spare, which the network does not run"):
            lost(torch.zeros(2, 3, 16, 16), images_per_chunk=chunk)
