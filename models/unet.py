"""The residual UNet of the paper's level 5 and 7 experiments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tangent_train.errors import SettingError, width_height

Convolution = Callable[[int, int], nn.Module]
"""Makes a layer from its numbers of input and output channels."""


def convolution_3x3(in_channels: int, out_channels: int) -> nn.Module:
    """Return a 3×3 convolution that keeps the size."""
    return nn.Conv2d(in_channels, out_channels, 3, padding=1)


class Residual(nn.Module):
    """Bottleneck 1×1 – 3×3 – 1×1 with a 1×1 shortcut, all batch-normalized (Jiang et al. 2019).

    Args:
        in_channels: Input channels.
        out_channels: Output channels. The bottleneck has the smaller of the two.
        convolution: Makes the layer in the middle.
    """

    def __init__(
        self, in_channels: int, out_channels: int, convolution: Convolution = convolution_3x3
    ) -> None:
        super().__init__()
        neck = min(in_channels, out_channels)
        self.body = nn.Sequential(
            nn.Conv2d(in_channels, neck, 1),
            nn.BatchNorm2d(neck),
            nn.ReLU(inplace=True),
            convolution(neck, neck),
            nn.BatchNorm2d(neck),
            nn.ReLU(inplace=True),
            nn.Conv2d(neck, out_channels, 1),
            nn.BatchNorm2d(out_channels),
        )
        self.shortcut = nn.Sequential(
            nn.Conv2d(in_channels, out_channels, 1), nn.BatchNorm2d(out_channels)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return features ``(B, out_channels, h, w)``."""
        return torch.relu(self.body(x) + self.shortcut(x))


class Down(nn.Sequential):
    """2×2 average pooling and a residual block.

    The released code halves the resolution bilinearly, after the first 1×1 convolution and again
    in the shortcut. At a ratio of ½ that is a 2×2 mean, which commutes with a 1×1 convolution:
    pooling once, first, gives the same numbers with a quarter of the work.

    Args:
        in_channels: Input channels.
        out_channels: Output channels.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__(nn.AvgPool2d(2), Residual(in_channels, out_channels))


class _Up(nn.Module):
    """A finer resolution, merged with the encoder's features of that resolution."""

    def __init__(self, up: nn.Module, merge: nn.Module) -> None:
        super().__init__()
        self.up = up
        self.merge = merge

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        merged: Tensor = self.merge(torch.cat([self.up(x), skip], dim=1))
        return merged


class ResidualUNet(nn.Module):
    """UNet of residual blocks, for any kind of convolution (after Jiang et al. 2019).

    Args:
        in_channels: Channels of the image.
        num_classes: Classes K.
        widths: Channels at each resolution, from the finest.
        convolutions: Make the convolutions at each resolution.
        pools: Layers that lead from each resolution but the coarsest to the next.
        ups: Make the layers that lead to each resolution but the coarsest from the next, from their
            number of channels.
        block: Makes a block from its numbers of input and output channels and the convolution.
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        widths: Sequence[int],
        convolutions: Sequence[Convolution],
        pools: Sequence[nn.Module],
        ups: Sequence[Callable[[int], nn.Module]],
        block: Callable[[int, int, Convolution], nn.Module] = Residual,
    ) -> None:
        super().__init__()
        self.stem = convolutions[0](in_channels, widths[0])
        self.downs = nn.ModuleList(
            nn.Sequential(pool, block(*channels, convolution))
            for pool, channels, convolution in zip(
                pools, pairwise(widths), convolutions[1:], strict=True
            )
        )
        self.ups = nn.ModuleList()
        below = widths[-1]
        for i in reversed(range(len(widths) - 1)):
            out_channels = widths[max(i - 1, 0)]
            merge = below + widths[i], out_channels, convolutions[i]
            self.ups.append(_Up(ups[i](below), block(*merge)))
            below = out_channels
        self.head = convolutions[0](below, num_classes)

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Return scores of every pixel."""
        skips = [self.stem(images)]
        for down in self.downs:
            skips.append(down(skips[-1]))
        x = skips.pop()
        for up in self.ups:
            x = up(x, skips.pop())
        scores: Tensor = self.head(x)
        return scores


def _transposed(channels: int) -> nn.Module:
    return nn.ConvTranspose2d(channels, channels, 4, stride=2, padding=1)


class UNet(ResidualUNet):
    """Residual UNet (paper, supplement, "Network training details"; after Jiang et al. 2019).

    With the default widths, four input channels and 14 classes it has the 2,896,654 trainable
    parameters of the released code.

    Args:
        in_channels: Channels of the image: 3 for RGB, 4 for RGB-D.
        num_classes: Classes K.
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
        fewer = len(widths) - 1
        super().__init__(
            in_channels,
            num_classes,
            widths,
            convolutions=[convolution_3x3] * len(widths),
            pools=[nn.AvgPool2d(2) for _ in range(fewer)],
            ups=[_transposed] * fewer,
        )
        self.size_multiple = 2**fewer


def check_size(
    size: Sequence[int], network: nn.Module, multiple: int, only: tuple[int, int] | None
) -> None:
    """Refuse images of a size that a network cannot take.

    Args:
        size: Rows and columns of the images.
        network: Network, for the message.
        multiple: Number of which both sides have to be multiples: the network's stride.
        only: Rows and columns that the images must have; None for any.

    Raises:
        SettingError: The images have another size.
    """
    if tuple(size) == only or (only is None and not any(side % multiple for side in size)):
        return
    if only is None:
        expected = f"sides that are multiples of {multiple}"
        remedy = (
            f"Set representation.crop_multiple={multiple}, or choose another representation.dim, "
            "level or network. Signals on an icosphere need a network such as network=ugscnn."
        )
    else:
        expected = width_height(only)
        kind = "icosphere, with its elements" if only[0] == 1 else "erp"
        remedy = f"Set representation={kind}, and network.level to the level of the images."
    subject = f"image size for the {type(network).__name__}"
    raise SettingError(subject, found=width_height(size), expected=expected, remedy=remedy)
