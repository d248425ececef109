"""RGB networks for images with further channels."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["of_channels", "widen_stem", "with_channels"]

_RGB = 3


@registered
def widen_stem(network: nn.Module, in_channels: int) -> nn.Module:
    """Let a network for RGB images take further channels, depth for example.

    The filters of the further channels start at zero (paper, supplement, "Level 10 parameters"):
    at first the network does with RGB-D exactly what it did with RGB.

    Args:
        network: Any; its first convolution, in the order of definition, must be that of the image.
        in_channels: Channels wanted, red, green and blue first.

    Returns:
        The same network, changed in place unless `in_channels` is 3.

    Raises:
        SettingError: Less than three channels, or the first convolution does not take three.
    """
    if in_channels < _RGB:
        raise SettingError("network.in_channels", found=in_channels, expected="3 or more")
    stem = next((module for module in network.modules() if isinstance(module, nn.Conv2d)), None)
    if stem is None or stem.in_channels != _RGB or stem.groups != 1:
        raise SettingError(
            f"first convolution of {type(network).__name__}",
            found=stem or "none",
            expected="one that takes the three channels of an RGB image",
        )
    if in_channels > _RGB:
        stem.weight = nn.Parameter(with_channels(stem.weight.detach(), in_channels))
        stem.in_channels = in_channels
    return network


def with_channels(weight: Tensor, channels: int) -> Tensor:
    """Filters for so many input channels: those of further ones are zero, others are left out.

    Args:
        weight: ``(out, in, h, w)``.
        channels: Input channels wanted.

    Returns:
        ``(out, channels, h, w)``.
    """
    further = max(0, channels - weight.shape[1])
    zeros = weight.new_zeros(weight.shape[0], further, *weight.shape[2:])
    return torch.cat([weight[:, :channels], zeros], dim=1)


def of_channels(weight: Tensor, places: Sequence[int | None]) -> Tensor:
    """Filters for these input channels.

    Args:
        weight: ``(out, in, h, w)``.
        places: For every channel wanted, which one of `weight` it is; None for a new one, whose
            filters are zero.

    Returns:
        ``(out, len(places), h, w)``.
    """
    zeros = torch.zeros_like(weight[:, 0])
    return torch.stack([zeros if k is None else weight[:, k] for k in places], dim=1)
