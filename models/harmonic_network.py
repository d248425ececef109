"""Networks of torch-harmonics, and its transforms, for equirectangular images."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from tangent_train.errors import of_extra
from tangent_train.geometry import equirect_shape

_GRID = "legendre-gauss"


class HarmonicNetwork(nn.Module):
    """Segmentation network of torch-harmonics for whole equirectangular images.

    Rows of equirectangular images are at pixel centers, a grid that torch-harmonics does not have.
    Its nearest grid is that of Gauss and Legendre, whose rows are at most a quarter of a row away.
    Convolutions and resampling at full resolution take this grid; harmonic transforms at full
    resolution are exact, see `use_pixel_rows`. Columns are exact: the networks do not depend on
    the longitude. All is computed in float32, also with mixed precision.

    Args:
        architecture: Network of ``torch_harmonics.examples.models``.
        in_channels: Channels of the image.
        num_classes: Classes K.
        level: Level s of the panorama.
        options: Further arguments of the network.

    Raises:
        SettingError: torch-harmonics is missing.
    """

    def __init__(
        self,
        architecture: Literal[
            "SphericalUNet", "SphericalSegformer", "SphericalFourierNeuralOperator"
        ],
        in_channels: int,
        num_classes: int,
        level: int,
        options: Mapping[str, Any],
    ) -> None:
        super().__init__()
        with of_extra("spectral", f"network={architecture}"):
            from torch_harmonics.examples import models as library
        self.fixed_size = equirect_shape(level)
        arguments: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list | tuple) else value
            for name, value in options.items()
        }
        arguments |= {
            "img_size": self.fixed_size,
            "in_chans": in_channels,
            "out_chans": num_classes,
        }
        with warnings.catch_warnings():  # about the library's own default
            warnings.filterwarnings("ignore", "The 'morlet' basis type is deprecated")
            self.network = getattr(library, architecture)(grid=_GRID, **arguments)
        for name in ("trans_down", "itrans_up"):  # of the Fourier neural operator
            if hasattr(self.network, name):
                use_pixel_rows(getattr(self.network, name))
        for module in self.network.modules():
            if hasattr(module, "attention_handle"):
                # An operator of torch cannot be copied, a function can.
                handle = module.attention_handle
                module.attention_handle = lambda *values, handle=handle: handle(*values)

    def forward(
        self, images: Float[Tensor, "batch channels height width"]
    ) -> Float[Tensor, "batch classes height width"]:
        """Return scores of every pixel of the images."""
        with torch.autocast(images.device.type, enabled=False):  # transforms need float32
            scores: Tensor = self.network(images.float())
        return scores


def use_pixel_rows(transform: nn.Module) -> None:
    """Set the rows of a transform of torch-harmonics to the pixel centers of panoramas.

    With H rows, the forward transform is exact for degrees below H/2 (Fejér's first quadrature
    rule integrates polynomials in the sine of the latitude up to degree H − 1).

    Args:
        transform: ``RealSHT`` or ``InverseRealSHT``, changed in place.
    """
    from torch_harmonics.legendre import legpoly

    made: Any = transform
    polynomials = legpoly(made.mmax, made.lmax, pixel_colatitudes(made.nlat).cos())
    if hasattr(made, "pct"):
        made.pct = polynomials.mT.contiguous().float()
    else:
        made.weights = (2 * math.pi * polynomials * pixel_row_weights(made.nlat)).float()


def pixel_colatitudes(rows: int) -> Tensor:
    """Return the angles from the north pole of the rows of a panorama, float64 ``(H,)``."""
    return (torch.arange(rows, dtype=torch.float64) + 0.5) * math.pi / rows


def pixel_row_weights(rows: int) -> Tensor:
    """Return the weights of Fejér's first quadrature rule, which sum to 2, float64 ``(H,)``."""
    k = torch.arange(1, rows // 2 + 1, dtype=torch.float64)
    waves = (2 * k * pixel_colatitudes(rows)[:, None]).cos() / (4 * k**2 - 1)
    return (1 - 2 * waves.sum(dim=1)) * 2 / rows
