"""Networks that modules of this package hold."""

from __future__ import annotations

from collections.abc import Iterator

from torch import nn

__all__ = ["HELD", "held_networks"]

HELD = "network"
"""What they call the network they hold: `SphereContext`, `AuxiliaryHead` and others."""


def held_networks(network: nn.Module) -> Iterator[nn.Module]:
    """A network, the one it holds, the one that holds, and so on."""
    held: object = network
    while isinstance(held, nn.Module):
        yield held
        held = getattr(held, HELD, None)
