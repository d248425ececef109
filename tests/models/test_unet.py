from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from models import UNet
from models.residual import Down
from tangent_train.errors import SettingError


@pytest.mark.parametrize(
    ("in_channels", "num_classes", "parameters"),
    [(4, 14, 2_896_654), (3, 14, 2_896_654 - 9 * 16), (4, 13, 2_896_654 - 9 * 16 - 1)],
)
def test_parameters_are_those_of_the_released_code(
    in_channels: int, num_classes: int, parameters: int
) -> None:
    network = UNet(in_channels, num_classes)
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) == parameters


@pytest.mark.parametrize("size", [(32, 32), (64, 96)])
def test_scores_have_the_size_of_the_images(size: tuple[int, int]) -> None:
    scores = UNet(3, 5, (4, 8, 8, 8, 8, 8))(torch.zeros(2, 3, *size))
    assert scores.shape == (2, 5, *size)


def test_averaging_first_equals_halving_after_the_first_convolution() -> None:
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


def test_channels_last_gives_the_same_scores() -> None:
    network = UNet(4, 14, (8, 16, 32, 32)).eval()
    images = torch.randn(3, 4, 24, 40)
    expected = network(images)
    network.to(memory_format=torch.channels_last)
    torch.testing.assert_close(
        network(images.to(memory_format=torch.channels_last)), expected, atol=1e-5, rtol=1e-4
    )


def test_every_parameter_gets_a_gradient() -> None:
    network = UNet(3, 4, (4, 6, 8))
    network(torch.randn(2, 3, 16, 16)).square().sum().backward()
    assert all(p.grad is not None for p in network.parameters())


def test_a_side_that_does_not_fit_is_refused() -> None:
    with pytest.raises(SettingError, match=r"48×64; expected sides that are multiples of 32"):
        UNet(3, 4)(torch.zeros(1, 3, 48, 64))


@pytest.mark.parametrize("widths", [(16,), (), (16, 0)])
def test_impossible_widths_are_refused(widths: tuple[int, ...]) -> None:
    with pytest.raises(SettingError, match="UNet widths"):
        UNet(3, 4, widths)
