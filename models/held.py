"""Networks that modules of this package hold."""

from __future__ import annotations

import inspect
from collections.abc import Iterator

from torch import nn

__all__ = ["HELD", "held_networks"]

HELD = "network"
"""What they call the network they hold: `SphereContext`, `AuxiliaryHead` and others."""


def held_networks(network: nn.Module) -> Iterator[nn.Module]:
    """A network, the one it hands all its arguments on to, the one that does that, and so on.

    What hands on nothing but images (``forward`` without ``*arguments``) is the last.
    """
    held: object = network
    while isinstance(held, nn.Module):
        yield held
        parameters = inspect.signature(held.forward).parameters.values()
        hands_on = any(parameter.kind is parameter.VAR_POSITIONAL for parameter in parameters)
        held = getattr(held, HELD, None) if hands_on else None
