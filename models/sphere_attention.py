"""Attention between the tokens of a sphere, by content and by the angle between them."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["SphereAttention", "angular_attention"]

_USUAL_WIDTH = 128
_KAPPAS = (0.1, 30.0)
"""At first: from heads that look all around to ones that look some 15° far."""

_ALIGNMENT = 8
"""Sizes of heads that fast kernels take are multiples of it."""


@registered
class SphereAttention(nn.Module):
    """Lets all images of a sphere see each other: multi-head attention between their tokens.

    To a head's logits κ (dᵢ·dⱼ − 1) is added, with the directions d of both tokens and a
    concentration κ that every head learns. Directions enter in no other way: turning all of them
    by one rotation changes nothing, and any images of the sphere may be missing. A mixer of
    `SphereContext`.

    To a token is added what it sees on the sphere less what it would see in its own image: the
    share of attention that other images have, times how their mean differs from that of its own.
    An image alone, as a photo, receives nothing and gives no gradient. The last layer starts at
    zero and is trained by several images of a sphere only: a network trained on photos computes
    the same with it and without, whatever images are there.

    Args:
        channels: Channels C of the tokens.
        heads: Heads of the attention.
        width: Channels of queries, keys and values, of all heads together; None for those of the
            tokens, at most 128.
        elevation: Tell tokens how far up they look (z of their direction). For spheres whose
            vertical axis is that of the world; rotations then do change the result.

    Raises:
        SettingError: `width` is no multiple of `heads`, or one of them is not positive.

    Example:
        >>> mixer = SphereAttention(channels=16, heads=2)
        >>> bool(mixer(torch.ones(1, 20, 16, 3, 3), torch.ones(1, 20, 3, 3, 3)).any())
        False
    """

    def __init__(
        self, channels: int, heads: int = 8, width: int | None = None, elevation: bool = False
    ) -> None:
        super().__init__()
        if heads < 1:
            raise SettingError("heads of SphereAttention", found=heads, expected="1 or more")
        if width is None:
            width = max(heads, min(channels, _USUAL_WIDTH) // heads * heads)
        if width < 1 or width % heads:
            raise SettingError(
                "width of SphereAttention", found=width, expected=f"a multiple of its {heads} heads"
            )
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.elevation = nn.Linear(1, channels, bias=False) if elevation else None
        self.queries_keys_values = nn.Linear(channels, 3 * width)
        low, high = map(math.log, _KAPPAS)
        self.log_kappa = nn.Parameter(torch.linspace(low, high, heads))
        self.output = nn.Linear(width, channels, bias=False)
        for layer in (self.elevation, self.output):
            if layer is not None:
                nn.init.zeros_(layer.weight)

    def forward(
        self,
        tokens: Float[Tensor, "spheres images channels rows columns"],
        directions: Float[Tensor, "spheres images 3 rows columns"],
    ) -> Float[Tensor, "spheres images channels rows columns"]:
        """What is added to every token.

        Args:
            tokens: Features of all images there are of each sphere.
            directions: Unit vectors the tokens look along.
        """
        spheres, images, channels, rows, columns = tokens.shape
        listed = tokens.movedim(2, -1).flatten(1, 3)
        along = directions.movedim(2, -1).flatten(1, 3)
        x = self.norm(listed)
        if self.elevation is not None:
            x = x + self.elevation(along[..., 2:].to(x.dtype))
        queries, keys, values = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2)
            for part in self.queries_keys_values(x).chunk(3, dim=-1)
        )
        kappa = self.log_kappa.exp()
        seen = angular_attention(queries, keys, values, along, kappa)
        own = seen  # of an image alone: nothing is added, with a gradient (0) for all parameters
        if images > 1:
            queries, keys, values = (
                part.unflatten(2, (images, -1)).transpose(1, 2).flatten(0, 1)
                for part in (queries, keys, values)
            )
            along = along.reshape(spheres * images, -1, 3)
            own = angular_attention(queries, keys, values, along, kappa)
            own = own.reshape(spheres, images, *own.shape[1:]).transpose(1, 2).flatten(2, 3)
        others = (seen - own).to(x.dtype).transpose(1, 2).flatten(2)
        added: Tensor = self.output(others)
        return added.reshape(spheres, images, rows, columns, channels).movedim(-1, 2)


def angular_attention(
    queries: Float[Tensor, "spheres heads tokens size"],
    keys: Float[Tensor, "spheres heads tokens size"],
    values: Float[Tensor, "spheres heads tokens size"],
    directions: Float[Tensor, "spheres tokens 3"],
    kappa: Float[Tensor, " heads"],
) -> Float[Tensor, "spheres heads tokens size"]:
    """Attention with logits ``q·k / √size + κ (dᵢ·dⱼ − 1)``, in single precision or better.

    The −1 is the same for all keys, and κ dᵢ·dⱼ is a scalar product too: three more numbers in
    queries and keys are all it takes, and no kernel has to hold tokens × tokens of memory.

    Args:
        queries: Of every head.
        keys: Of every head.
        values: Of every head.
        directions: Unit vectors the tokens look along.
        kappa: Concentration of every head.

    Returns:
        For every query, the mean of the values, in that precision: differences of means stay exact.
    """
    with _without_autocast(queries.device.type):
        size, exact = queries.shape[-1], torch.promote_types(queries.dtype, torch.float32)
        directions = directions[:, None].to(exact).expand(*queries.shape[:-1], 3)
        query = torch.cat(
            [queries.to(exact) * size**-0.5, kappa.to(exact)[:, None, None] * directions], -1
        )
        key = torch.cat([keys.to(exact), directions], -1)
        # The kernels want one size for all three.
        further = -(size + 3) % _ALIGNMENT
        query, key = (functional.pad(part, (0, further)) for part in (query, key))
        value = functional.pad(values.to(exact), (0, further + 3))
        seen = functional.scaled_dot_product_attention(query, key, value, scale=1.0)
    return seen[..., :size]


def _without_autocast(device: str) -> AbstractContextManager[object]:
    """No half precision here; nothing at all where there is none, as for exporters."""
    if torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device):
        return torch.autocast(device, enabled=False)
    return nullcontext()
