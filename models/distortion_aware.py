"""Distortion-aware convolutions, which sample an equirectangular image on the sphere.

Tateno et al. 2018 ("Distortion-aware convolutional filters for dense prediction in panoramic
images") replace the sampling of a network that was trained on photos; Coors et al. 2018
("SphereNet") train with it. Weights, and the names of the tensors, are those of the ordinary
network.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from functools import lru_cache
from itertools import chain

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch._compile import _disable_dynamo
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from tangent_train.errors import SettingError, width_height
from tangent_train.geometry import (
    equirect_to_lonlat,
    lonlat_to_equirect,
    lonlat_to_xyz,
    xyz_to_lonlat,
)
from tangent_train.geometry.sphere import gnomonic_points_xyz

_SAMPLES = 2**24
"""Most samples in memory at a time: taps of output pixels, times channels and images."""

_LARGEST_PITCH = math.pi / 4
"""Of feature maps with less than 8 columns, whose taps would lie behind the horizon."""


class DistortionAwareConv2d(nn.Conv2d):
    """A 2D convolution on features of a whole equirectangular image ``(B, C, h, w)``, w = 2 h.

    At each output pixel the taps form a grid on the tangent plane of its direction, with a pitch of
    tan(2π/w) times the dilation (Tateno et al. 2018, Coors et al. 2018). Features are interpolated
    bilinearly, around the seam and across the poles, never padded with zeros. Output size, and the
    place of an output pixel in the input, follow from kernel, stride, padding and dilation as in an
    ordinary convolution.

    Taps are sampled some rows at a time, and again for the gradient: they would take as much memory
    as the features times the size of the kernel.
    """

    def _conv_forward(self, input: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:  # noqa: A002
        height, width = shape = input.shape[-2], input.shape[-1]
        if width != 2 * height:
            raise SettingError(
                "distortion-aware convolutions",
                found=f"an image or features of {width_height(shape)}",
                expected="whole equirectangular ones, twice as wide as high",
                remedy="Choose representation=erp_distortion_aware (views=erp_distortion_aware), "
                "with rows that are a multiple of the network's stride. A network that pads its "
                "features itself cannot be used.",
            )
        left, right, top, bottom = self._reversed_padding_repeated_twice
        kernel, dilation = self.kernel_size, self.dilation
        (rows, first_row), (columns, first_column) = (
            ((side + sum(pads) - d * (k - 1) - 1) // step + 1, d * (k - 1) / 2 - pads[0])
            for side, pads, k, d, step in zip(
                shape, ((top, bottom), (left, right)), kernel, dilation, self.stride, strict=True
            )
        )
        centers = first_row, self.stride[0], rows
        exact = torch.promote_types(input.dtype, torch.float32)
        taps = torch.from_numpy(_row_taps(shape, kernel, dilation, centers)).to(input.device, exact)
        across = torch.arange(columns, device=input.device) * self.stride[1] + first_column
        framed = _framed(input.to(exact))

        def convolve(framed: Tensor, part: Tensor) -> Tensor:
            u = (part[:, :, None, :, 0] + across[:, None]) % width
            v = (part[:, :, None, :, 1] + 1).expand_as(u)
            grid = torch.stack([u * 2 / width, v * 2 / (height + 1)], dim=-1) - 1
            grid = grid.reshape(1, len(part) * kernel[0], columns * kernel[1], 2)
            sampled = functional.grid_sample(
                framed, grid.expand(len(framed), -1, -1, -1), align_corners=True
            )
            return functional.conv2d(
                sampled.to(input.dtype), weight, bias, stride=kernel, groups=self.groups
            )

        step = max(1, _SAMPLES // (input.shape[:2].numel() * math.prod(kernel) * columns))
        parts = torch.split(taps, step)
        if torch.is_grad_enabled():
            outputs = [checkpoint(convolve, framed, part, use_reentrant=False) for part in parts]
        else:
            outputs = [convolve(framed, part) for part in parts]
        return torch.cat(outputs, dim=-2)


@_disable_dynamo  # torch.compiler.disable would import the compiler now
@lru_cache(maxsize=256)
def _row_taps(
    shape: tuple[int, int],
    kernel: tuple[int, ...],
    dilation: tuple[int, ...],
    centers: tuple[float, int, int],
) -> NDArray[np.float64]:
    """Return the taps of an output pixel of each row; they are the same in every column.

    Args:
        shape: ``(h, w)`` of the features.
        kernel: Rows and columns of taps.
        dilation: Dilation down and across.
        centers: Row of the first output pixel in the features, rows between them, and their number.

    Returns:
        ``(rows, *kernel, 2)`` columns to the right of the output pixel, and rows in the features.
    """
    first, step, count = centers
    middle = (shape[1] - 1) / 2
    rows = first + step * np.arange(count)
    directions = lonlat_to_xyz(
        equirect_to_lonlat(np.stack([np.full(count, middle), rows], axis=-1), shape)
    )
    pitch = math.tan(min(2 * math.pi / shape[1], _LARGEST_PITCH))
    dense = ((kernel[0] - 1) * dilation[0] + 1, (kernel[1] - 1) * dilation[1] + 1)
    taps = gnomonic_points_xyz(directions, dense, pitch).reshape(count, *dense, 3)
    lonlat = xyz_to_lonlat(taps[:, :: dilation[0], :: dilation[1]])
    return lonlat_to_equirect(lonlat, shape) - (middle, 0)


def _framed(features: Tensor) -> Tensor:
    """Return features with a row across each pole, and the first column again after the last."""
    beyond = features[..., [0, -1], :].roll(features.shape[-1] // 2, -1)
    tall = torch.cat([beyond[..., :1, :], features, beyond[..., 1:, :]], dim=-2)
    return torch.cat([tall, tall[..., :1]], dim=-1)


def make_distortion_aware(network: nn.Module) -> nn.Module:
    """Return a network with distortion-aware convolutions, which shares the tensors of a network.

    All `torch.nn.Conv2d` with more than one tap are replaced, also those that embed patches.
    Pooling, upsampling and transposed convolutions stay as they are.

    Args:
        network: Network for equirectangular images; it is not changed.

    Raises:
        SettingError: The network has no such convolutions, or other kinds of them.

    Example:
        >>> make_distortion_aware(nn.Conv2d(3, 8, 3, padding=1))(torch.ones(1, 3, 16, 32)).shape
        torch.Size([1, 8, 16, 32])
    """
    found = {
        name: type(module)
        for name, module in network.named_modules()
        if isinstance(module, nn.Conv2d) and max(module.kernel_size) > 1
    }
    known = nn.Conv2d, DistortionAwareConv2d
    others = [f"{name}, a {kind.__name__}" for name, kind in found.items() if kind not in known]
    if others or not found:
        raise SettingError(
            "distortion-aware convolutions",
            found=f"{type(network).__name__} with {others[0] if others else 'none'}",
            expected="convolutions of the class torch.nn.Conv2d with more than one tap",
            remedy="" if others else "Import a network of an ONNX file from torch instead.",
        )
    return _copied(network, found, DistortionAwareConv2d)


def make_ordinary(network: nn.Module) -> nn.Module:
    """Return a network with ordinary convolutions, for photos; see `make_distortion_aware`."""
    kind = DistortionAwareConv2d
    found = [name for name, module in network.named_modules() if isinstance(module, kind)]
    return _copied(network, found, nn.Conv2d) if found else network


def _copied(network: nn.Module, names: Iterable[str], kind: type[nn.Module]) -> nn.Module:
    """Return a copy with the same tensors, in which some modules are of another class."""
    tensors = chain(network.parameters(), network.buffers())
    copied = copy.deepcopy(network, {id(tensor): tensor for tensor in tensors})
    for name in names:
        copied.get_submodule(name).__class__ = kind
    return copied
