"""The plain UNet of the paper's OmniSYNTHIA transfer experiments."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

_ENCODERS = (32, 64, 128, 256)
_DECODERS = ((512, 256), (256, 128), (128, 64), (64, 32))
"""Bottleneck and output channels, coarsest first."""


def _convolution(in_channels: int, out_channels: int, size: int) -> list[nn.Module]:
    return [
        nn.Conv2d(in_channels, out_channels, size, padding=size // 2),
        nn.BatchNorm2d(out_channels),
        nn.ReLU(inplace=True),
    ]


def _encoder(in_channels: int, out_channels: int) -> nn.Sequential:
    """Return two convolutions; pooling follows after the skip connection branches off."""
    return nn.Sequential(
        *_convolution(in_channels, out_channels, 3), *_convolution(out_channels, out_channels, 3)
    )


def _decoder(in_channels: int, neck: int, out_channels: int) -> nn.Sequential:
    """Return two convolutions, an upsampling by 2, and a 1×1 convolution."""
    return nn.Sequential(
        *_convolution(in_channels, neck, 3),
        *_convolution(neck, neck, 3),
        nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
        *_convolution(neck, out_channels, 1),
    )


class HexUNet(nn.Module):
    """UNet of the OmniSYNTHIA experiments (paper, table "transfer"; after Zhang et al. 2019).

    With three inputs and 14 outputs it has the 7,248,718 trainable parameters of the released code.

    Args:
        in_channels: Channels of the image: 3 for RGB, 4 for RGB-D.
        num_classes: Classes K.

    Example:
        >>> sum(p.numel() for p in HexUNet(3, 14).parameters())
        7248718
    """

    size_multiple = 2 ** len(_ENCODERS)

    def __init__(self, in_channels: int, num_classes: int) -> None:
        super().__init__()
        inputs = (in_channels, *_ENCODERS[:-1])
        self.encoders = nn.ModuleList(map(_encoder, inputs, _ENCODERS))
        self.pool = nn.MaxPool2d(2)
        decoders = []
        below = _ENCODERS[-1]
        for (neck, out_channels), skip in zip(_DECODERS, reversed(_ENCODERS), strict=True):
            decoders.append(_decoder(below, neck, out_channels))
            below = out_channels + skip
        self.decoders = nn.ModuleList(decoders)
        self.head = nn.Sequential(
            *_convolution(below, 32, 3),
            *_convolution(32, 32, 3),
            nn.Conv2d(32, num_classes, 3, padding=1),
        )

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Return scores of every pixel."""
        skips = []
        x = images
        for encoder in self.encoders:
            skips.append(encoder(x))
            x = self.pool(skips[-1])
        for decoder in self.decoders:
            x = torch.cat([decoder(x), skips.pop()], dim=1)
        scores: Tensor = self.head(x)
        return scores
