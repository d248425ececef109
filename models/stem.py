"""Extending RGB networks to images with additional channels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tangent_train.errors import SettingError

_RGB = 3


def widen_stem(network: nn.Module, in_channels: int) -> nn.Module:
    """Extend a network of RGB images to additional channels, such as depth.

    The filters of additional channels start at zero (paper, supplement, "Level 10 parameters"), so
    that the network first returns the same for RGB-D as for RGB.

    Args:
        network: Network whose first convolution processes the image.
        in_channels: Number of channels; the first three are red, green and blue.

    Returns:
        The network, changed in place.

    Raises:
        SettingError: The first convolution does not take three channels.
    """
    convolutions = (module for module in network.modules() if isinstance(module, nn.Conv2d))
    stem = next(convolutions, None)
    if stem is None or stem.in_channels != _RGB or stem.groups != 1:
        raise SettingError(
            f"first convolution of {type(network).__name__}",
            found=stem or "none",
            expected="one that takes the three channels of an RGB image",
            remedy="Networks of RGB images only need data.inputs=[rgb].",
        )
    if in_channels > _RGB:
        places = [*range(_RGB), *[None] * (in_channels - _RGB)]
        stem.weight = nn.Parameter(select_channels(stem.weight.detach(), places))
        stem.in_channels = in_channels
    return network


def select_channels(weight: Tensor, places: Sequence[int | None]) -> Tensor:
    """Return filters for a selection of input channels.

    Args:
        weight: ``(out, in, h, w)`` filters.
        places: Index in `weight` of each new channel; None for zeros.

    Returns:
        ``(out, len(places), h, w)``.
    """
    zeros = torch.zeros_like(weight[:, 0])
    return torch.stack([zeros if k is None else weight[:, k] for k in places], dim=1)
