"""Features of tangent images rendered to a coarse sphere, convolved there, and rendered back."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_directions
from tangent_train.registry import registered
from tangent_train.rendering.taps import Taps, bilinear_equirect_taps, sample

__all__ = ["SphereRendering", "equirect_to_tokens", "pad_equirect", "tokens_to_equirect"]

_LEAST_SPREAD = 0.1
"""With less, weights between two tokens would be 0 in single precision."""
_NO_NEIGHBORS = 1e-9
"""Keeps the mean over no pairs of neighbours at 0."""


@registered
class SphereRendering(nn.Module):
    """Lets the images of a sphere see each other through one coarse panorama of features.

    What the paper suggests in "Limitations" (supplement), "to incorporate the rendering into the
    convolution operation": the tokens of all images are reduced to a few channels and averaged into
    an equirectangular map, which is convolved with its longitude wrapped and its rows reflected
    beyond the poles; every token then reads the map where it looks. A mixer of `SphereContext`, to
    be compared with `SphereAttention`: it costs as much for one image as for all of a sphere, and
    turning the sphere about any axis but the vertical one changes what the convolutions make of it.

    The last layer starts at zero, so that nothing is added until it is trained.

    Args:
        channels: Channels C of the tokens.
        width: Channels of the map.
        rows: Rows of the map, which has twice as many columns.
        dilations: Of each 3×3 convolution, in pixels of the map; with the default a pixel sees 7 to
            each side, 79° of 16 rows.
        spread: Standard deviation of a token's footprint on the map, in distances between tokens.

    Raises:
        SettingError: A number is out of range.

    Example:
        >>> mixer = SphereRendering(channels=8)
        >>> bool(mixer(torch.ones(1, 20, 8, 3, 3), torch.ones(1, 20, 3, 3, 3)).any())
        False
    """

    pixels_xyz: Tensor

    def __init__(
        self,
        channels: int,
        width: int = 64,
        rows: int = 16,
        dilations: Sequence[int] = (1, 2, 4),
        spread: float = 0.5,
    ) -> None:
        super().__init__()
        _check(width, rows, dilations, spread)
        self.spread, self.margins = spread, tuple(dilations)
        self.norm = nn.LayerNorm(channels)
        self.reduce = nn.Linear(channels, width)
        # One input more: how much of each pixel is seen.
        self.convolutions = nn.ModuleList(
            nn.Conv2d(width + 1, width, 3, dilation=dilation) for dilation in dilations
        )
        self.expand = nn.Linear(width, channels)
        nn.init.zeros_(self.expand.weight)
        nn.init.zeros_(self.expand.bias)
        pixels_xyz = torch.as_tensor(equirect_directions((rows, 2 * rows)), dtype=torch.float32)
        self.register_buffer("pixels_xyz", pixels_xyz, persistent=False)

    def forward(
        self,
        tokens: Float[Tensor, "spheres images channels rows columns"],
        directions: Float[Tensor, "spheres images 3 rows columns"],
    ) -> Float[Tensor, "spheres images channels rows columns"]:
        """What the sphere around them adds to the tokens.

        Args:
            tokens: Features of all images there are of each sphere.
            directions: Unit vectors the tokens look along.
        """
        reduced = self.reduce(self.norm(tokens.movedim(2, -1))).movedim(-1, 2)
        features, coverage = tokens_to_equirect(reduced, directions, self.pixels_xyz, self.spread)
        coverage = coverage.to(features.dtype)
        for convolution, margin in zip(self.convolutions, self.margins, strict=True):
            seen = pad_equirect(torch.cat([features, coverage], dim=1), margin)
            features = features + functional.gelu(convolution(seen))
        context: Tensor = self.expand(equirect_to_tokens(features, directions).movedim(2, -1))
        return context.movedim(-1, 2)


def _check(width: int, rows: int, dilations: Sequence[int], spread: float) -> None:
    if width < 1:
        raise SettingError("width of SphereRendering", found=width, expected="1 or more")
    if not dilations or min(dilations) < 1 or max(dilations) > rows:
        raise SettingError(
            "dilations of SphereRendering",
            found=list(dilations),
            expected=f"one or more from 1 to its {rows} rows",
        )
    if not _LEAST_SPREAD <= spread < math.inf:
        expected = f"{_LEAST_SPREAD} or more"
        raise SettingError("spread of SphereRendering", found=spread, expected=expected)


def tokens_to_equirect(
    tokens: Tensor, directions: Tensor, pixels_xyz: Tensor, spread: float = 0.5
) -> tuple[Tensor, Tensor]:
    """Average tokens into panoramas, every pixel from those that look close to it.

    A token's weight falls with the angle θ to the pixel as ``exp((cos θ − 1) / σ²)``, a Gaussian on
    the sphere, where σ is `spread` times the distance between the tokens of its image (or between
    rows of the panorama, if that is more). The weights of a pixel are divided by their sum; only
    where that is less than one token gives at its distance from the next, there is less than full
    coverage, and values fade to zero. So overlap does not count twice, there are no holes between
    tokens that lie further apart than pixels, and columns that crowd at the poles are all filled:
    the transposed bilinear sampling, which gives every token to four pixels, has those faults.

    Differentiable with respect to the tokens. Memory is spheres × pixels × tokens of a sphere.

    Args:
        tokens: ``(S, n, C, h, w)``, n images of each of S spheres.
        directions: ``(S, n, 3, h, w)`` unit vectors.
        pixels_xyz: ``(H, W, 3)`` unit vectors, as `equirect_directions` gives them.
        spread: Standard deviation σ in distances between tokens.

    Returns:
        Panoramas ``(S, C, H, W)``, and their coverage ``(S, 1, H, W)``, from 0 to 1.
    """
    height, width = pixels_xyz.shape[:2]
    least_rad = math.pi / height
    variance = spread**2 * _squared_spacing(directions).clamp(min=least_rad**2)
    variances = variance[..., None, None].expand(-1, -1, *tokens.shape[3:]).flatten(1)
    x, y, z = directions.movedim(2, 1).flatten(2)[:, :, None].unbind(1)
    # No matrix product: the fast ones of GPUs round too much for differences from 1.
    pixel_x, pixel_y, pixel_z = pixels_xyz.flatten(0, 1)[..., None].unbind(1)
    cosine = pixel_x * x + pixel_y * y + pixel_z * z
    weight = torch.exp((cosine - 1) / variances[:, None])
    weight = weight / weight.sum(-1, keepdim=True).clamp(min=math.exp(-0.5 / spread**2))
    panoramas = tokens.movedim(2, 1).flatten(2) @ weight.to(tokens.dtype).mT
    coverage = weight.sum(-1).reshape(-1, 1, height, width)
    return panoramas.reshape(*panoramas.shape[:2], height, width), coverage


def _squared_spacing(directions: Tensor) -> Tensor:
    """Mean squared chord between tokens side by side, of every image; 0 for a single token.

    Args:
        directions: ``(S, n, 3, h, w)`` unit vectors.

    Returns:
        ``(S, n)``.
    """
    pairs = [directions.diff(dim=-1).flatten(3), directions.diff(dim=-2).flatten(3)]
    chords = torch.cat(pairs, dim=-1).square().sum(2)
    # Sums and no branch, so that a trace holds for other sizes too.
    return chords.sum(-1) / (torch.ones_like(chords).sum(-1) + _NO_NEIGHBORS)


def equirect_to_tokens(panoramas: Tensor, directions: Tensor) -> Tensor:
    """Sample panoramas bilinearly where tokens look, seam and poles included.

    Differentiable with respect to the panoramas.

    Args:
        panoramas: ``(S, C, H, W)``.
        directions: ``(S, n, 3, h, w)`` vectors of any length but 0.

    Returns:
        ``(S, n, C, h, w)`` of the dtype of the panoramas.
    """
    height, width = panoramas.shape[2:]
    x, y, z = directions.movedim(2, 0).flatten(2)
    u = (torch.atan2(y, x) / (2 * math.pi) + 0.5) * width - 0.5
    v = (0.5 - torch.atan2(z, (x * x + y * y).sqrt()) / math.pi) * height - 0.5
    taps = bilinear_equirect_taps(u.flatten(), v.flatten(), (height, width))
    # All panoramas of a channel as one row of numbers, each sphere's taps moved to its own.
    first = torch.arange(panoramas.shape[0], device=panoramas.device)[:, None] * (height * width)
    source = taps.source + first.expand(u.shape).flatten()
    values = sample(panoramas.movedim(1, 0).flatten(1), Taps(source, taps.weight))
    sizes = (directions.shape[axis] for axis in (0, 1, 3, 4))
    return values.reshape(panoramas.shape[1], *sizes).movedim(0, 2)


def pad_equirect(panoramas: Tensor, margin: int) -> Tensor:
    """Continue panoramas on all sides: longitude wraps, rows reflect with a half-turn.

    Args:
        panoramas: ``(..., H, W)`` with an even number of columns.
        margin: Pixels on each side, at most H.

    Returns:
        ``(..., H + 2 margin, W + 2 margin)``.
    """
    half = panoramas.shape[-1] // 2
    north, south = (
        rows.flip(-2).roll(half, -1)
        for rows in (panoramas[..., :margin, :], panoramas[..., -margin:, :])
    )
    tall = torch.cat([north, panoramas, south], dim=-2)
    return torch.cat([tall[..., -margin:], tall, tall[..., :margin]], dim=-1)
