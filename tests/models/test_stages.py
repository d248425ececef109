"""Stages inside networks, and the auxiliary head at one of them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from models import AuxiliaryHead, UNet
from models.stages import stage_channels
from tests.models.sphere_networks import STAGE, small_unet
from tests.tasks.odd_networks import Looking


@pytest.mark.parametrize(
    ("network", "stage", "in_channels", "channels"),
    [
        (UNet(4, 14), "downs.4", 4, 256),
        (nn.Sequential(nn.Conv2d(3, 4, 1), Looking()), "0", 3, 4),  # it needs values
    ],
)
def test_channels_are_found_by_running_a_copy(
    network: nn.Module, stage: str, in_channels: int, channels: int
) -> None:
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    assert stage_channels(network, stage, in_channels) == channels
    assert network.training
    assert not any(module._forward_hooks for module in network.modules())
    torch.testing.assert_close(network.state_dict(), before, rtol=0, atol=0)


def _seen(module: nn.Module) -> list[Tensor]:
    """Collects what a module is given."""
    inputs: list[Tensor] = []
    module.register_forward_pre_hook(lambda _module, given: inputs.append(given[0]))
    return inputs


def test_the_auxiliary_head_scores_the_stage_in_training_only() -> None:
    network, images = small_unet(), torch.randn(2, 3, 16, 20)
    module = AuxiliaryHead(network, STAGE, in_channels=3, num_classes=3)
    features = _seen(network.ups[0])
    outputs = module.train()(images)
    assert list(outputs) == ["out", "aux"]
    assert outputs["out"].shape == (2, 3, 16, 20)
    weight, bias = module.auxiliary_head.parameters()
    expected = torch.einsum("kc,nchw->nkhw", weight[:, :, 0, 0], features[0])
    torch.testing.assert_close(outputs["aux"], expected + bias[:, None, None])
    outputs["aux"].square().sum().backward(retain_graph=True)
    grads = {n: p.grad is not None for n, p in module.named_parameters()}
    assert all(grads[n] == ("ups" not in n and "network.head" not in n) for n in grads)
    inputs = _seen(module.auxiliary_head)
    assert torch.equal(module.eval()(images), network.eval()(images))
    assert not inputs, "it costs nothing in evaluation"
