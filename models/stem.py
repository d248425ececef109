"""RGB networks for images with further channels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tangent_train.errors import SettingError
from tangent_train.registry import registered

_RGB = 3


@registered
def widen_stem(network: nn.Module, in_channels: int) -> nn.Module:
    """Extend a network for RGB images to further channels, such as depth.

    The filters of the further channels start at zero (paper, supplement, "Level 10 parameters"):
    at first, the network computes the same from RGB-D as from RGB.

    Args:
        network: Any network; its first convolution must be the one that sees the image.
        in_channels: Channels wanted; the first three are red, green and blue.

    Returns:
        The network, changed in place.

    Raises:
        SettingError: Fewer than three channels, or the first convolution does not take three.
    """
    if in_channels < _RGB:
        raise SettingError("network.in_channels", found=in_channels, expected="3 or more")
    convolutions = (module for module in network.modules() if isinstance(module, nn.Conv2d))
    stem = next(convolutions, None)
    if stem is None or stem.in_channels != _RGB or stem.groups != 1:
        raise SettingError(
            f"first convolution of {type(network).__name__}",
            found=stem or "none",
            expected="one that takes the three channels of an RGB image",
            remedy="Networks that only take those need data.inputs=[rgb].",
        )
    if in_channels > _RGB:
        places = [*range(_RGB), *[None] * (in_channels - _RGB)]
        stem.weight = nn.Parameter(select_channels(stem.weight.detach(), places))
        stem.in_channels = in_channels
    return network


def select_channels(weight: Tensor, places: Sequence[int | None]) -> Tensor:
    """Return filters for other input channels.

    Args:
        weight: ``(out, in, h, w)``.
        places: For every channel wanted, its index in `weight`; None for zeros.

    Returns:
        ``(out, len(places), h, w)``.
    """
    zeros = torch.zeros_like(weight[:, 0])
    return torch.stack([zeros if k is None else weight[:, k] for k in places], dim=1)
