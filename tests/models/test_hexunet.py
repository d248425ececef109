from __future__ import annotations

import pytest
import torch

from models import HexUNet
from tangent_train.errors import SettingError


@pytest.mark.parametrize(
    ("in_channels", "num_classes", "parameters"),
    [(3, 14, 7_248_718), (4, 14, 7_248_718 + 9 * 32), (3, 13, 7_248_718 - 9 * 32 - 1)],
)
def test_parameters_are_those_of_the_released_code(
    in_channels: int, num_classes: int, parameters: int
) -> None:
    network = HexUNet(in_channels, num_classes)
    assert sum(p.numel() for p in network.parameters() if p.requires_grad) == parameters


def test_convolutions_are_those_of_the_paper_in_order() -> None:
    convolutions = [m for m in HexUNet(3, 14).modules() if isinstance(m, torch.nn.Conv2d)]
    layers = [(m.in_channels, m.out_channels, m.kernel_size[0]) for m in convolutions]
    encoders = [(3, 32), (32, 32), (32, 64), (64, 64), (64, 128), (128, 128), (128, 256)]
    expected = [(*channels, 3) for channels in (*encoders, (256, 256))]
    for below, neck, out in ((256, 512, 256), (512, 256, 128), (256, 128, 64), (128, 64, 32)):
        expected += [(below, neck, 3), (neck, neck, 3), (neck, out, 1)]
    assert layers == [*expected, (64, 32, 3), (32, 32, 3), (32, 14, 3)]


@pytest.mark.parametrize("size", [(16, 16), (48, 32)])
def test_scores_have_the_size_of_the_images(size: tuple[int, int]) -> None:
    assert HexUNet(4, 5)(torch.zeros(2, 4, *size)).shape == (2, 5, *size)


def test_skip_connections_carry_what_pooling_removes() -> None:
    """Changing one pixel by little changes its own score although every maximum stays."""
    network = HexUNet(3, 2).eval()
    images = torch.rand(1, 3, 32, 32, requires_grad=True)
    network(images)[0, 0, 9, 9].backward()
    assert images.grad is not None
    assert images.grad[0, :, 9, 9].abs().min() > 0
    assert (images.grad[0, :, 5:14, 5:14] != 0).all(), "the head sees 9×9 pixels at least"


def test_every_parameter_gets_a_gradient() -> None:
    network = HexUNet(3, 4)
    network(torch.randn(2, 3, 16, 16)).square().sum().backward()
    assert all(p.grad is not None for p in network.parameters())


def test_a_side_that_does_not_fit_is_refused() -> None:
    message = r"image size for the HexUNet: found 24×32; expected sides that are multiples of 16"
    with pytest.raises(SettingError, match=message):
        HexUNet(3, 4)(torch.zeros(1, 3, 24, 32))
