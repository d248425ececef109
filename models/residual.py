"""The residual block of Jiang et al. (2019), which UNet and shape classifier are made of."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["Down", "Residual"]


class Residual(nn.Module):
    """Bottleneck 1×1 – 3×3 – 1×1 with a 1×1 shortcut, every convolution normalised.

    Args:
        in_channels: Channels it takes.
        out_channels: Channels it gives; the neck has the fewer of both.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        neck = min(in_channels, out_channels)
        self.body = nn.Sequential(
            nn.Conv2d(in_channels, neck, 1),
            nn.BatchNorm2d(neck),
            nn.ReLU(inplace=True),
            nn.Conv2d(neck, neck, 3, padding=1),
            nn.BatchNorm2d(neck),
            nn.ReLU(inplace=True),
            nn.Conv2d(neck, out_channels, 1),
            nn.BatchNorm2d(out_channels),
        )
        self.shortcut = nn.Sequential(
            nn.Conv2d(in_channels, out_channels, 1), nn.BatchNorm2d(out_channels)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Features of the same resolution."""
        return torch.relu(self.body(x) + self.shortcut(x))


class Down(nn.Sequential):
    """Half the resolution.

    The original halves bilinearly after the first 1×1 convolution and again in the shortcut. At
    ratio ½ that is the mean of 2×2 pixels, and a mean commutes with a 1×1 convolution: averaging
    once, first, gives the same numbers with a quarter of the work.

    Args:
        in_channels: Channels it takes.
        out_channels: Channels it gives.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(nn.AvgPool2d(2), Residual(in_channels, out_channels))
