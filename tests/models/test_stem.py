from __future__ import annotations

import pytest
import torch
from torch import nn
from torchvision.models import mobilenet_v3_small

from models import widen_stem
from tangent_train.errors import SettingError


def test_further_channels_change_nothing_at_first_and_are_learned() -> None:
    torch.manual_seed(0)
    network = mobilenet_v3_small(weights=None).eval()
    images = torch.randn(2, 5, 64, 64)
    expected = network(images[:, :3])
    assert widen_stem(network, 5) is network
    scores = network(images)
    assert torch.equal(scores, expected)
    scores.square().sum().backward()
    stem = next(network.parameters())
    assert stem.shape[1] == 5
    assert stem.grad is not None
    assert stem.grad[:, 3:].abs().amax(dim=(0, 2, 3)).min() > 0


def test_three_channels_are_left_alone() -> None:
    network = nn.Sequential(nn.Conv2d(3, 2, 1))
    weight = network[0].weight
    assert widen_stem(network, 3)[0].weight is weight  # type: ignore[index]


@pytest.mark.parametrize(
    ("network", "in_channels", "message"),
    [
        (nn.Conv2d(3, 2, 1), 2, r"network\.in_channels: found 2; expected 3 or more"),
        (nn.Conv2d(1, 2, 1), 4, r"first convolution of Conv2d: found Conv2d\(1, 2"),
        (nn.Conv2d(3, 3, 1, groups=3), 4, "first convolution of Conv2d"),
        (nn.Linear(3, 2), 4, "first convolution of Linear: found none"),
    ],
)
def test_what_cannot_be_widened_is_refused(
    network: nn.Module, in_channels: int, message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        widen_stem(network, in_channels)
