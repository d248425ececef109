"""The residual UNet of the paper's level 5 and 7 experiments."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.residual import Down, Residual
from models.stride import check_sides
from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["UNet"]


class _Up(nn.Module):
    """Twice the resolution, joined with the encoder's features of that resolution."""

    def __init__(self, in_channels: int, skip_channels: int, out_channels: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(in_channels, in_channels, 4, stride=2, padding=1)
        self.merge = Residual(in_channels + skip_channels, out_channels)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        merged: Tensor = self.merge(torch.cat([self.up(x), skip], dim=1))
        return merged


@registered
class UNet(nn.Module):
    """Residual UNet (paper, supplement, "Network training details"; after Jiang et al. 2019).

    With the default widths, four inputs and 14 outputs it has the 2,896,654 trainable parameters
    of the released code.

    Args:
        in_channels: Channels of the image: 3 for RGB, 4 for RGB-D.
        num_classes: Score planes, the unknown class 0 included.
        widths: Channels at full, half, quarter … resolution.

    Example:
        >>> sum(p.numel() for p in UNet(4, 14).parameters())
        2896654
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        widths: Sequence[int] = (16, 32, 64, 128, 256, 256),
    ) -> None:
        super().__init__()
        if len(widths) < 2 or min(widths) < 1:
            raise SettingError(
                "UNet widths", found=list(widths), expected="two or more positive numbers"
            )
        self.stride = 2 ** (len(widths) - 1)
        self.stem = nn.Conv2d(in_channels, widths[0], 3, padding=1)
        self.downs = nn.ModuleList(Down(a, b) for a, b in pairwise(widths))
        ups = []
        below = widths[-1]
        for i in reversed(range(len(widths) - 1)):
            out_channels = widths[max(i - 1, 0)]
            ups.append(_Up(below, widths[i], out_channels))
            below = out_channels
        self.ups = nn.ModuleList(ups)
        self.head = nn.Conv2d(below, num_classes, 3, padding=1)

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Scores of every pixel.

        Raises:
            SettingError: A side is no multiple of the network's stride (32 by default).
        """
        check_sides(images, self.stride, "UNet", remedy=", or fewer network.widths")
        skips = [self.stem(images)]
        for down in self.downs:
            skips.append(down(skips[-1]))
        x = skips.pop()
        for up in self.ups:
            x = up(x, skips.pop())
        scores: Tensor = self.head(x)
        return scores
