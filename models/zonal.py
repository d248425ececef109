"""The zonal network of Esteves et al. (2018), which classifies shapes under any rotation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from models.harmonic_network import pixel_row_weights, use_pixel_rows
from tangent_train.errors import of_extra
from tangent_train.geometry import equirect_shape

_SLOPE = 0.1


class ZonalConvolution(nn.Module):
    """Convolution of panoramas with filters that do not depend on the direction.

    In spherical harmonics, ŷ_lm = 2π √(4π / (2l+1)) x̂_lm ĥ_l0 for degrees l below H/2. The
    weights are ĥ_l0 at a few degrees. It is interpolated between them, which makes filters local.

    Args:
        in_channels: Channels C.
        out_channels: Channels C'.
        shape: Rows H and columns W of the panorama.
        anchors: Weights of a filter.
        rows: Rows of the result: H, or less, without the highest degrees.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        shape: tuple[int, int],
        anchors: int,
        rows: int,
    ) -> None:
        super().__init__()
        with of_extra("spectral", "network"):
            from torch_harmonics import InverseRealSHT, RealSHT
        self._degrees, kept = shape[0] // 2, rows // 2
        weight = torch.empty(out_channels, in_channels, min(anchors, self._degrees))
        scale = 1 / (math.pi * math.sqrt(self._degrees * in_channels))
        self.weight = nn.Parameter(nn.init.trunc_normal_(weight, std=scale))
        gain = 2 * math.pi * (4 * math.pi / (2 * torch.arange(kept) + 1)).sqrt()
        self.gain: Tensor
        self.register_buffer("gain", gain, persistent=False)
        self.analysis = RealSHT(*shape, kept, kept, "legendre-gauss")
        self.synthesis = InverseRealSHT(rows, rows, kept, kept, "legendre-gauss")
        for transform in (self.analysis, self.synthesis):
            use_pixel_rows(transform)

    def forward(self, images: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d r r"]:
        """Return the convolved panoramas, with as many columns as rows, from the first column."""
        with torch.autocast(images.device.type, enabled=False):  # transforms need float32
            filters = functional.interpolate(
                self.weight, self._degrees, mode="linear", align_corners=True
            )
            response = filters[..., : len(self.gain)] * self.gain
            spectrum = torch.view_as_real(self.analysis(images.float()))
            spectrum = torch.einsum("bclmz,dcl->bdlmz", spectrum, response)
            result: Tensor = self.synthesis(torch.view_as_complex(spectrum.contiguous()))
        return result


class ZonalClassifier(nn.Module):
    """Classifies a shape by the equirectangular image of its sphere (Esteves et al. 2018).

    Each width stands for two convolutions. From the second width on, the first of them halves the
    resolution by leaving out the higher degrees (spectral pooling), and takes the features of all
    branches in the first branch. Means over the sphere, which do not depend on its rotation, and a
    linear layer follow. With two channels, one per branch, and 40 classes it has 487,592
    parameters: those of the released code without its second classifier, a loss in training. That
    code halves by means over 2×2 pixels.

    Args:
        in_channels: Channels of an image.
        num_classes: Number of classes.
        level: Level s of the image.
        branches: Channels of each branch, by index.
        widths: Channels of a branch at each resolution.
        anchors: Weights of a filter.

    Raises:
        SettingError: torch-harmonics is missing.
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        level: int,
        branches: Sequence[Sequence[int]] = ((0,), (1,)),
        widths: Sequence[int] = (16, 32, 64, 128),
        anchors: int = 8,
    ) -> None:
        super().__init__()
        self.fixed_size = equirect_shape(level)
        self.branches = [list(branch) for branch in branches]
        self.layers = nn.ModuleList()
        taken, shape = [len(branch) for branch in branches], self.fixed_size
        for number, width in enumerate(width for width in widths for _ in range(2)):
            rows = shape[0]
            if _is_halving(number):
                taken[0], rows = sum(taken), rows // 2
            blocks = [_block(channels, width, shape, anchors, rows) for channels in taken]
            self.layers.append(nn.ModuleList(blocks))
            taken, shape = [width] * len(taken), (rows, rows)
        self.areas: Tensor
        areas = pixel_row_weights(rows).float()[:, None] * rows / 2
        self.register_buffer("areas", areas, persistent=False)
        self.head = nn.Linear(sum(taken), num_classes)

    def forward(
        self, images: Float[Tensor, "batch views channels height width"]
    ) -> Float[Tensor, "batch classes"]:
        """Return class scores of shapes; several views of a shape are averaged."""
        flat = images.flatten(0, 1)
        features = [flat[:, branch] for branch in self.branches]
        layers: Any = self.layers
        for number, blocks in enumerate(layers):
            if _is_halving(number):
                features[0] = torch.cat(features, dim=1)
            features = [block(one) for block, one in zip(blocks, features, strict=True)]
        means = (torch.cat(features, dim=1) * self.areas).mean(dim=(-2, -1))
        scores: Tensor = self.head(means.view(*images.shape[:2], -1).mean(dim=1))
        return scores


def _is_halving(number: int) -> bool:
    """Return True for a layer that halves the resolution and merges the branches in the first."""
    return number > 0 and number % 2 == 0


def _block(
    in_channels: int, width: int, shape: tuple[int, int], anchors: int, rows: int
) -> nn.Sequential:
    norm = nn.BatchNorm2d(width)
    norm.register_parameter("weight", None)
    convolution = ZonalConvolution(in_channels, width, shape, anchors, rows)
    return nn.Sequential(convolution, norm, nn.PReLU(width, _SLOPE))
