"""A small network with a named stage."""

from __future__ import annotations

import torch
from torch import nn

from models import UNet

STAGE = "downs.1"


def small_unet() -> UNet:
    """Return a UNet of stride 4, whose deepest stage is `STAGE`."""
    return UNet(3, 3, (4, 6, 8))


def awake(module: nn.Module, scale: float = 0.5) -> nn.Module:
    """The module with random numbers, also where training starts from zero."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.normal_(0, scale)
    return module
