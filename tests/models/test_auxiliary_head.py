"""The auxiliary head: what it sees, when it runs, and that it is nothing but a head."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torchvision.models.segmentation import fcn_resnet50

from models import AuxiliaryHead, SphereContext
from tangent_train.errors import SettingError
from tests.models.sphere_networks import ATTENTION, STAGE, awake, small_unet, sphere_rays


def _seen(module: nn.Module) -> list[Tensor]:
    """Collects what a module is given."""
    inputs: list[Tensor] = []
    module.register_forward_pre_hook(lambda _module, given: inputs.append(given[0]))
    return inputs


def test_it_scores_the_stage_in_training_only() -> None:
    network, images = small_unet(), torch.randn(2, 3, 16, 20)
    module = AuxiliaryHead(network, STAGE, in_channels=3, num_classes=4)
    features = _seen(network.ups[0])
    inputs = _seen(module.auxiliary_head)
    outputs = module.train()(images)
    assert list(outputs) == ["out", "aux"]
    assert outputs["out"].shape == (2, 4, 16, 20)
    weight, bias = module.auxiliary_head.parameters()
    expected = torch.einsum("kc,nchw->nkhw", weight[:, :, 0, 0], features[0])
    expected = expected + bias[:, None, None]
    assert outputs["aux"].shape == (2, 4, 4, 5)
    torch.testing.assert_close(outputs["aux"], expected)
    inputs.clear()
    scores = module.eval()(images)
    assert torch.equal(scores, network.eval()(images))
    assert not inputs, "it costs nothing in evaluation"


def test_both_losses_reach_the_network() -> None:
    module = AuxiliaryHead(small_unet(), STAGE, in_channels=3, num_classes=4)
    outputs = module(torch.randn(2, 3, 16, 16))
    outputs["aux"].square().sum().backward(retain_graph=True)
    grads = {n: p.grad is not None for n, p in module.named_parameters()}
    assert all(grads[n] == ("ups" not in n and "network.head" not in n) for n in grads)
    outputs["out"].sum().backward()
    assert all(parameter.grad is not None for parameter in module.parameters())


@pytest.mark.parametrize("outside", [False, True])
def test_it_sees_features_with_their_context(outside: bool) -> None:
    images, rays = torch.randn(4, 3, 16, 16), sphere_rays(4)
    network = small_unet()
    features = _seen(network.ups[0])
    module: nn.Module
    if outside:
        context = SphereContext(network, STAGE, ATTENTION, in_channels=3)
        module = head = AuxiliaryHead(context, f"network.{STAGE}", 3, 4)
    else:
        head = AuxiliaryHead(network, STAGE, 3, 4)
        module = context = SphereContext(head, f"network.{STAGE}", ATTENTION, in_channels=3)
    features.clear()
    awake(context.mixer)
    inputs = _seen(head.auxiliary_head)
    for settings in ({}, {"rays": rays}):
        module.train()(images, **settings)
    assert len(features) == len(inputs) == 2
    assert torch.equal(inputs[0], features[0])
    assert torch.equal(inputs[1], features[1])
    assert not torch.allclose(inputs[0], inputs[1], atol=1e-3), "rays are passed on"


def test_it_adds_to_results_with_names() -> None:
    network: Any = fcn_resnet50(weights=None, weights_backbone=None, num_classes=3)
    module = AuxiliaryHead(network, "backbone.layer3", in_channels=3, num_classes=3)
    images = torch.randn(2, 3, 32, 32)
    outputs = module.train()(images)
    assert {name: tuple(tensor.shape) for name, tensor in outputs.items()} == {
        "out": (2, 3, 32, 32),
        "aux": (2, 3, 4, 4),
    }
    with torch.no_grad():
        assert list(module.eval()(images)) == ["out"]


def test_copies_are_on_their_own() -> None:
    module = AuxiliaryHead(small_unet(), STAGE, in_channels=3, num_classes=4)
    other, images = copy.deepcopy(module), torch.randn(2, 3, 16, 16)
    awake(module.auxiliary_head)
    torch.testing.assert_close(other(images)["out"], module(images)["out"])
    assert not torch.allclose(other(images)["aux"], module(images)["aux"])
    shapes = copy.deepcopy(module).to("meta")(images.to("meta"))
    assert shapes["aux"].shape == (2, 4, 4, 4)


def test_what_cannot_work_is_refused() -> None:
    with pytest.raises(SettingError, match=r"network\.num_classes: found null"):
        AuxiliaryHead(small_unet(), STAGE, in_channels=3)
    with pytest.raises(SettingError, match=r"found 'downs\.7'"):
        AuxiliaryHead(small_unet(), "downs.7", in_channels=3, num_classes=4)
    inner = AuxiliaryHead(small_unet(), STAGE, in_channels=3, num_classes=4)
    twice = AuxiliaryHead(inner, "network.stem", in_channels=3, num_classes=4)
    with pytest.raises(SettingError, match="found one with scores called aux"):
        twice.train()(torch.zeros(2, 3, 16, 16))
    network = small_unet()
    network.spare = nn.Conv2d(3, 4, 1)
    lost = AuxiliaryHead(network, "spare", num_classes=4, channels=4)
    with pytest.raises(SettingError, match="found spare; expected a stage that the network runs"):
        lost.train()(torch.zeros(2, 3, 16, 16))
