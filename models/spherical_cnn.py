"""The spherical CNN of Cohen et al. (2018): correlations of the sphere and of rotations.

A signal on rotations R = R_z(α) R_y(β) R_z(γ) is sampled on a grid of N × N × N angles, which is
exact for bandwidths up to N/2. Axes are β, γ, α, so that a panorama is a signal with one angle γ:
row and column are β and α. The angles β are those of pixel rows, and α starts at the first column.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.harmonic_network import pixel_colatitudes, pixel_row_weights
from tangent_train.geometry import equirect_shape


class RingCorrelation(nn.Module):
    """Correlation with filters on rings around the north pole (Cohen et al. 2018, equation 4).

    (f ⋆ ψ)(R) = Σ_p ψ_p f(R g_p) with the weights ψ_p at the rotations g_p = R_z(α_p) R_y(β_r), for
    P angles α_p on each ring β_r. A panorama is f(R) = f(R e_z). f is taken without degrees from b
    on. In Wigner matrices d^l, sums over the ring are Fourier coefficients ψ̂ of the weights:
    out^l_ma = Σ_r ψ̂_ra Σ_n f^l_mn d^l_an(β_r).

    Args:
        in_channels: Channels C.
        out_channels: Channels C'.
        rows: Angles β of f.
        bandwidth: Bandwidth b of the result, at most half of `rows`.
        rings_deg: Angle β_r of each ring from the pole, in degrees.
        points: Weights P of a ring, at least 2b.
        turns: Angles γ of f: 1 or `rows`.
        result_rows: Angles β, γ and α of the result, at least 2b.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        rows: int,
        bandwidth: int,
        rings_deg: Sequence[float],
        points: int,
        turns: int,
        result_rows: int,
    ) -> None:
        super().__init__()
        weight = torch.empty(in_channels, len(rings_deg), out_channels, points)
        scale = 1 / math.sqrt(in_channels * len(rings_deg) * points)
        self.weight = nn.Parameter(nn.init.normal_(weight, std=scale))
        # Frequencies 0 … b − 1, −b … −1.
        orders = torch.cat([torch.arange(bandwidth), torch.arange(-bandwidth, 0)])
        self.orders: Tensor
        self.register_buffer("orders", orders, persistent=False)
        self._rows = result_rows
        # A panorama does not depend on γ: its order n is 0.
        self._n = slice(None if turns > 1 else 1)
        analysis = _wigner(bandwidth, pixel_colatitudes(rows))[..., :bandwidth, self._n]
        analysis = analysis * pixel_row_weights(rows)[:, None, None] / 2
        tilt = _wigner(bandwidth, torch.deg2rad(torch.tensor(rings_deg, dtype=torch.float64)))
        synthesis = _wigner(bandwidth, pixel_colatitudes(result_rows))[..., :bandwidth, :]
        gain = 2 * torch.arange(bandwidth)[:, None, None, None] + 1
        self.analysis: Tensor
        self.tilt: Tensor
        self.synthesis: Tensor
        self.register_buffer("analysis", analysis.float(), persistent=False)
        self.register_buffer("tilt", tilt[..., self._n].float(), persistent=False)
        self.register_buffer("synthesis", (gain * synthesis).float(), persistent=False)

    def forward(
        self, values: Float[Tensor, "batch channels rows turns columns"]
    ) -> Float[Tensor, "batch filters beta gamma alpha"]:
        """Return the correlations on the grid of the result, in float32."""
        with torch.autocast(values.device.type, enabled=False):
            bandwidth = self.analysis.shape[0]
            waves = torch.fft.rfft(values.float(), norm="forward")[..., :bandwidth]
            waves = torch.fft.fft(waves, dim=-2, norm="forward")[..., self.orders[self._n], :]
            spectrum = torch.view_as_real(waves)
            spectrum = torch.einsum("xcjnmz,ljmn->xclmnz", spectrum, self.analysis)
            spectrum = torch.einsum("xclmnz,lran->xcrlmaz", spectrum, self.tilt)
            filters = torch.fft.ifft(self.weight, norm="forward")[..., self.orders]
            mixed = torch.einsum(
                "xcrlma,crda->xdlma", torch.view_as_complex(spectrum.contiguous()), filters
            )
            spectrum = torch.view_as_real(mixed)
            spectrum = torch.einsum("xdlmaz,ljma->xdjamz", spectrum, self.synthesis)
            waves = torch.view_as_complex(spectrum.contiguous())
            low, high = waves[..., :bandwidth, :], waves[..., bandwidth:, :]
            between = low.new_zeros(*low.shape[:-2], self._rows - 2 * bandwidth, bandwidth)
            waves = torch.fft.ifft(torch.cat([low, between, high], -2), dim=-2, norm="forward")
            result: Tensor = torch.fft.irfft(waves, self._rows, norm="forward")
        return result


class SphericalCNN(nn.Module):
    """Classifies a shape by the equirectangular image of its sphere (Cohen et al. 2018).

    A correlation of the sphere, then correlations of rotations, each followed by batch
    normalization and ReLU on the grid of its bandwidth; the mean over all rotations, which does
    not depend on the rotation of the shape; a linear layer. Filters are rings at the equator, as
    in the authors' code for shapes (github.com/jonkhler/s2cnn). Widths and bandwidths are those of
    its `model_original`, which takes the maximum instead of the mean, and [100, 100] and [16, 10]
    those of its `model`.

    Args:
        in_channels: Channels of an image.
        num_classes: Number of classes.
        level: Level s of the image.
        widths: Channels after each correlation.
        bandwidths: Bandwidth after each correlation, limited to the one before, at first to 2^s.
        rings_deg: Angle of each ring of the filters from the pole, in degrees.
        oversampling: Angles of a grid, divided by 2b. ReLU exceeds the bandwidth b, so that with 1,
            as published, scores change slightly under rotation; with 2, about five times less.
    """

    def __init__(
        self,
        in_channels: int,
        num_classes: int,
        level: int,
        widths: Sequence[int] = (50, 70, 350),
        bandwidths: Sequence[int] = (32, 22, 7),
        rings_deg: Sequence[float] = (90.0,),
        oversampling: int = 1,
    ) -> None:
        super().__init__()
        self.fixed_size = equirect_shape(level)
        layers: list[nn.Module] = []
        points = rows = self.fixed_size[0]
        turns, channels = 1, in_channels
        for width, most in zip(widths, bandwidths, strict=True):
            bandwidth = min(most, points // 2)
            size = 2 * bandwidth * oversampling
            layers += [
                RingCorrelation(channels, width, rows, bandwidth, rings_deg, points, turns, size),
                nn.BatchNorm3d(width),
                nn.ReLU(inplace=True),
            ]
            points, channels = 2 * bandwidth, width
            rows = turns = size
        self.layers = nn.Sequential(*layers)
        self.areas: Tensor
        self.register_buffer("areas", pixel_row_weights(rows).float() / 2, persistent=False)
        self.head = nn.Linear(channels, num_classes)

    def forward(
        self, images: Float[Tensor, "batch views channels height width"]
    ) -> Float[Tensor, "batch classes"]:
        """Return class scores of shapes; several views of a shape are averaged."""
        features = self.layers(images.flatten(0, 1).unsqueeze(-2))
        means = features.mean(dim=(-2, -1)) @ self.areas
        scores: Tensor = self.head(means.view(*images.shape[:2], -1).mean(dim=1))
        return scores


def _wigner(bandwidth: int, angles: Tensor) -> Tensor:
    """Return d^l_mn(β), float64 ``(l, β, m, n)``, with order −m at index 2b − m, else zeros."""
    shape = bandwidth, len(angles), 2 * bandwidth, 2 * bandwidth
    matrices = torch.zeros(shape, dtype=torch.float64)
    for degree, matrix in enumerate(matrices):
        m = torch.arange(-degree, degree + 1)
        raised = (degree * (degree + 1) - m[:-1] * m[1:]).double().sqrt() / 2
        generator = torch.diag(raised, 1) - torch.diag(raised, -1)  # −i J_y
        matrix[:, m[:, None], m] = torch.matrix_exp(angles[:, None, None] * generator)
    return matrices
