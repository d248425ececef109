"""The paper's two UNets, and what importing a network imports."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from models import HexUNet, UNet, ZonalClassifier
from models.unet import Down, check_size
from tangent_train.checkpoints.loaded import declared_sizes
from tangent_train.errors import SettingError


def test_pooling_first_equals_halving_after_the_first_convolution() -> None:
    down = Down(6, 10).eval()
    x = torch.randn(2, 6, 8, 12)
    residual: Any = down[1]
    first, *rest = residual.body

    def halve(y: torch.Tensor) -> torch.Tensor:
        return nn.functional.interpolate(y, scale_factor=0.5, mode="bilinear")

    body = halve(first(x))
    for layer in rest:
        body = layer(body)
    convolution, norm = residual.shortcut
    expected = torch.relu(body + norm(halve(convolution(x))))
    torch.testing.assert_close(down(x), expected)


def test_skip_connections_carry_what_pooling_removes() -> None:
    """Changing one pixel by little changes its own score although every maximum stays."""
    network = HexUNet(3, 2).eval()
    images = torch.rand(1, 3, 32, 32, requires_grad=True)
    network(images)[0, 0, 9, 9].backward()
    assert images.grad is not None
    assert images.grad[0, :, 9, 9].abs().min() > 0
    assert (images.grad[0, :, 5:14, 5:14] != 0).all(), "the head sees 9×9 pixels at least"


@pytest.mark.parametrize("network", [UNet(3, 5, (4, 6, 8)), HexUNet(3, 5)])
def test_scores_have_the_size_of_the_images_and_every_parameter_learns(network: nn.Module) -> None:
    scores = network(torch.randn(2, 3, 16, 48))
    assert scores.shape == (2, 5, 16, 48)
    scores.square().sum().backward()
    assert all(p.grad is not None for p in network.parameters())
    network.eval()
    images = torch.randn(2, 3, 16, 32)
    expected = network(images)
    last = network.to(memory_format=torch.channels_last)(images)
    torch.testing.assert_close(last, expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(
    ("network", "size", "message"),
    [
        (UNet(3, 4), (48, 64), r"64 × 48 \(.*\); expected sides that are multiples of 32"),
        (UNet(3, 4), (1, 2562), "2562 × 1 .*network=ugscnn"),
        (ZonalClassifier(2, 4, 3), (32, 64), "found 64 × 32 .* 32 × 16 .*representation=erp"),
    ],
)
def test_images_that_do_not_fit_are_refused(
    network: nn.Module, size: tuple[int, int], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        check_size(size, network, *declared_sizes(network))
