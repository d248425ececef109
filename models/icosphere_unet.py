"""A UNet on nested icospheres, for the convolution of any table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal

from torch import Tensor, nn
from torch.nn import functional

from models.mapped import MappedConv, Table, collect, vertex_means, vertex_parents
from models.unet import ResidualUNet
from tangent_train.errors import SettingError
from tangent_train.geometry.icosphere import IcosphereElements

Pooling = Literal["first", "mean", "max"]
Unpooling = Literal["zeros", "ones", "mean", "repeat"]


def _resampled(x: Tensor, table: Table) -> Tensor:
    return collect(x, table).transpose(1, 2).unsqueeze(2)


class _Pool(nn.Module):
    """Signals on the next coarser icosphere."""

    def __init__(self, pooling: Pooling, level: int, positions: int) -> None:
        super().__init__()
        self.pooling, self.level, self.positions = pooling, level, positions

    def forward(self, x: Tensor) -> Tensor:
        if self.pooling == "first":
            return x[..., : self.positions]
        if x.shape[-1] != 4 * self.positions:  # not faces
            return _resampled(x, vertex_means(self.level + 1))
        children = x.reshape(*x.shape[:-1], self.positions, 4)
        return children.mean(-1) if self.pooling == "mean" else children.amax(-1)


class _Unpool(nn.Module):
    """Signals on the next finer icosphere."""

    def __init__(self, unpooling: Unpooling, level: int, positions: int) -> None:
        super().__init__()
        self.unpooling, self.level, self.positions = unpooling, level, positions

    def forward(self, x: Tensor) -> Tensor:
        if self.unpooling == "repeat":
            return x.repeat_interleave(4, -1)
        if self.unpooling == "mean":
            return _resampled(x, vertex_parents(self.level))
        new = 0, self.positions - x.shape[-1]
        return functional.pad(x, new, value=float(self.unpooling == "ones"))


def levels_of(widths: Sequence[int], level: int) -> range:
    """Return the level of each width, the finest first.

    Args:
        widths: Channels at each level.
        level: Level of the finest icosphere.

    Raises:
        SettingError: There are more widths than levels.
    """
    if len(widths) > level + 1:
        raise SettingError("network.widths", found=widths, expected=f"at most {level + 1}")
    return range(level, level - len(widths), -1)


class IcosphereUNet(ResidualUNet):
    """UNet of Jiang et al. (2019) on icospheres of decreasing levels, for any table.

    With `mesh_operators`, four inputs and 15 outputs, it has the 5,180,239 trainable parameters of
    the article's network. Like `UNet`, it pools before the first 1×1 convolution of a block instead
    of after it. Except for the maximum of faces, the values are the same; statistics of batch
    normalization see the coarser level.

    Args:
        in_channels: Channels of the signal: 3 for RGB, 4 for RGB-D.
        num_classes: Classes K.
        level: Level s of the icosphere.
        table: Function that builds the table of a level, whose positions are vertices or faces.
        widths: Channels at each level, from s down.
        pooling: Signals of a coarser level: the `first` vertices, which it has too, or the `mean`
            of each and its ring. For faces, the `mean` or `max` of four.
        unpooling: Values of the new vertices of a finer level, before a convolution: `zeros` (the
            article), `ones` (its released code) or the `mean` of the two vertices of the edge. For
            faces: `repeat`.
        normalized_ups: True for normalization and ReLU after that convolution.

    Raises:
        SettingError: There are more widths than levels, or a kind of pooling does not fit the
            positions of the table.

    Example:
        >>> from models import mesh_operators
        >>> network = IcosphereUNet(4, 15, 5, mesh_operators)
        >>> sum(p.numel() for p in network.parameters())
        5180239
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        level: int,
        table: Callable[[int], Table],
        widths: Sequence[int] = (32, 64, 128, 256, 512, 512),
        pooling: Pooling = "first",
        unpooling: Unpooling = "zeros",
        normalized_ups: bool = False,
    ) -> None:
        tables = [table(r) for r in levels_of(widths, level)]
        positions = [one.inputs for one in tables]
        elements: IcosphereElements = "vertices"
        choices = {"pooling": ("first", "mean"), "unpooling": ("zeros", "ones", "mean")}
        if positions[0] == 20 * 4**level:
            elements = "faces"
            choices = {"pooling": ("mean", "max"), "unpooling": ("repeat",)}
        for name, given in (("pooling", pooling), ("unpooling", unpooling)):
            if given not in choices[name]:
                expected = f"{' or '.join(choices[name])} for signals on {elements}"
                raise SettingError(f"network.{name}", found=given, expected=expected)
        convolutions = [partial(MappedConv, table=one) for one in tables]

        def up(channels: int, k: int) -> nn.Module:
            unpool = _Unpool(unpooling, level - k, positions[k])
            layers = [unpool, convolutions[k](channels, channels)]
            if normalized_ups:
                layers += [nn.BatchNorm2d(channels), nn.ReLU(inplace=True)]
            return nn.Sequential(*layers)

        super().__init__(
            in_channels,
            num_classes,
            widths,
            convolutions,
            pools=[_Pool(pooling, level - k, positions[k]) for k in range(1, len(widths))],
            ups=[partial(up, k=k) for k in range(len(widths) - 1)],
        )
