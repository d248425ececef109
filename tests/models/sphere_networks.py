"""Small networks with context, and where their images look."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from models import SphereAttention, SphereContext, UNet
from tangent_train.geometry import TangentGrid

ATTENTION: Any = partial(SphereAttention, heads=2, width=8)
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


def small_context(network: nn.Module | None = None, **settings: Any) -> SphereContext:
    """With a mixer that does something."""
    inner = small_unet() if network is None else network
    context = SphereContext(inner, STAGE, ATTENTION, **{"in_channels": 3, "tokens": 2, **settings})
    awake(context.mixer, 2.0)
    nn.init.zeros_(context.mixer.get_parameter("log_kappa"))
    return context


def tangent_rays(grid: TangentGrid) -> Tensor:
    """``(N, 3, 3)`` float64, of all images of a grid."""
    half = grid.pitch * grid.dim / 2
    axes = torch.tensor(grid.world_from_camera)
    return axes @ torch.diag(torch.tensor([half, half, 1.0], dtype=torch.float64))


def sphere_rays(count: int, spheres: int = 1) -> Tensor:
    """``(spheres, count, 3, 3)`` float32: images of a grid in no regular order."""
    faces = torch.randperm(20, generator=torch.Generator().manual_seed(0))[:count]
    rays = tangent_rays(TangentGrid(0, 5))[faces]
    return rays.float().expand(spheres, -1, -1, -1)
