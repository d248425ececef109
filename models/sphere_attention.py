"""Cross-image attention: tokens attend to each other by content and by angular distance."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

_KAPPAS = (0.1, 30.0)
"""Initial concentrations, from heads that see the whole sphere to heads that see about 15°."""

_ALIGNMENT = 8
"""Memory-efficient kernels need head sizes that are multiples of this number."""


class SphereAttention(nn.Module):
    """Multi-head attention between the tokens of all images of a sphere, for `SphereContext`.

    κ (dᵢ·dⱼ − 1) is added to the logits of a head, with the directions d of the two tokens and a
    learned concentration κ per head. Directions are not used otherwise, so the result is
    invariant to rotations of the sphere, and works with any subset of its images.

    A token receives its attention over the sphere minus its attention over its own image. So a
    single image, such as a photo, passes through unchanged and yields no gradient. The output layer
    starts at zero and is trained only with several images of a sphere, so a network trained on
    photos returns the same with and without this module.

    Args:
        channels: Channels C of the tokens.
        heads: Number of attention heads.
        width: Channels of queries, keys and values, summed over the heads; a multiple of `heads`.

    Example:
        >>> mixer = SphereAttention(channels=16, heads=2)
        >>> bool(mixer(torch.ones(1, 20, 16, 3, 3), torch.ones(1, 20, 3, 3, 3)).any())
        False
    """

    def __init__(self, channels: int, heads: int = 8, width: int = 128) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.queries_keys_values = nn.Linear(channels, 3 * width)
        low, high = map(math.log, _KAPPAS)
        self.log_kappa = nn.Parameter(torch.linspace(low, high, heads))
        self.output = nn.Linear(width, channels, bias=False)
        nn.init.zeros_(self.output.weight)

    def forward(
        self,
        tokens: Float[Tensor, "spheres images channels rows columns"],
        directions: Float[Tensor, "spheres images 3 rows columns"],
    ) -> Float[Tensor, "spheres images channels rows columns"]:
        """Return the residual for every token.

        Args:
            tokens: Features of the images of each sphere.
            directions: Unit viewing directions of the tokens.
        """
        spheres, images, channels, rows, columns = tokens.shape
        x = self.norm(tokens.movedim(2, -1).flatten(1, 3))
        along = directions.movedim(2, -1).flatten(1, 3)
        queries, keys, values = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for part in self.queries_keys_values(x).chunk(3, dim=-1)
        )
        kappa = self.log_kappa.exp()
        seen = angular_attention(queries, keys, values, along, kappa)
        queries, keys, values = (
            part.unflatten(2, (images, -1)).transpose(1, 2).flatten(0, 1)
            for part in (queries, keys, values)
        )
        along = along.reshape(spheres * images, -1, 3)
        inside = angular_attention(queries, keys, values, along, kappa)
        inside = inside.reshape(spheres, images, *inside.shape[1:]).transpose(1, 2).flatten(2, 3)
        others = (seen - inside).to(x.dtype).transpose(1, 2).flatten(2)
        added: Tensor = self.output(others)
        return added.reshape(spheres, images, rows, columns, channels).movedim(-1, 2)


def angular_attention(
    queries: Float[Tensor, "spheres heads tokens size"],
    keys: Float[Tensor, "spheres heads tokens size"],
    values: Float[Tensor, "spheres heads tokens size"],
    directions: Float[Tensor, "spheres tokens 3"],
    kappa: Float[Tensor, " heads"],
) -> Float[Tensor, "spheres heads tokens size"]:
    """Attend with logits ``q·k / √size + κ (dᵢ·dⱼ − 1)``, in single precision or better.

    The −1 is common to all keys, and κ dᵢ·dⱼ is also a dot product. So three more numbers in
    queries and keys suffice, and no kernel needs tokens × tokens of memory.

    Args:
        queries: Queries of every head.
        keys: Keys of every head.
        values: Values of every head.
        directions: Unit viewing directions of the tokens.
        kappa: Concentration of every head.

    Returns:
        Weighted means of the values, in that precision so that their differences are accurate.
    """
    with torch.autocast(queries.device.type, enabled=False):
        size, exact = queries.shape[-1], torch.promote_types(queries.dtype, torch.float32)
        directions = directions[:, None].to(exact).expand(*queries.shape[:-1], 3)
        query = torch.cat(
            [queries.to(exact) * size**-0.5, kappa.to(exact)[:, None, None] * directions], -1
        )
        key = torch.cat([keys.to(exact), directions], -1)
        # Memory-efficient kernels need one size for all three.
        further = -(size + 3) % _ALIGNMENT
        query, key = (functional.pad(part, (0, further)) for part in (query, key))
        value = functional.pad(values.to(exact), (0, further + 3))
        seen = functional.scaled_dot_product_attention(query, key, value, scale=1.0)
    return seen[..., :size]
