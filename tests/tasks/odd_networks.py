"""Networks that an exporter has a hard time with, and what it means to compute the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tangent_train.checkpoints.loaded import LoadedNetwork


class Tied(nn.Module):
    """Two names for one tensor."""

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(4, 4, 1)
        self.second = self.first
        self.head = nn.Conv2d(4, 4, 1)

    def forward(self, images: Tensor) -> dict[str, Tensor]:
        return {"out": self.head(self.second(self.first(images)).relu())}


class _Plain(nn.Conv2d):
    def __init__(self, channels: int = 4, classes: int = 4) -> None:
        super().__init__(channels, classes, 1)


class OneSize(_Plain):
    """Something learned for every pixel."""

    fixed_size = (24, 40)

    def __init__(self, channels: int = 4, classes: int = 4) -> None:
        super().__init__(channels, classes)
        self.places = nn.Parameter(torch.randn(classes, 24, 40))

    def forward(self, images: Tensor) -> Tensor:
        return super().forward(images) + self.places


class Tracing(_Plain):
    """Another computation while it is traced."""

    def forward(self, images: Tensor) -> Tensor:
        return super().forward(images) * (2 if torch.compiler.is_compiling() else 1)


class Looking(_Plain):
    """Another computation for other values: exporters write only one of them."""

    def forward(self, images: Tensor) -> Tensor:
        return super().forward(images) * (2 if bool(images.sum() > 0) else 1)


class Sure(_Plain):
    """Depth with a confidence."""

    def forward(self, images: Tensor) -> Any:
        depth, confidence, *_ = super().forward(images).exp().unbind(dim=1)
        return {"out": depth, "confidence": confidence}


def config_section(name: str) -> dict[str, Any]:
    """Settings of a network of this module."""
    return {"_target_": f"{__name__}.{name}"}


def some_images(trained: LoadedNetwork, count: int, size: tuple[int, int]) -> Tensor:
    """Normalized images of its channels."""
    return torch.randn(count, trained.normalization.channels, *size)


def scores_of(trained: LoadedNetwork, images: Tensor) -> Tensor:
    """Return PyTorch's scores of images."""
    with torch.no_grad():
        scores: Tensor = trained.network(images)
    return scores


def assert_same(found: Any, expected: Tensor) -> None:
    """To 1e-4, of the scores and of their range."""
    span = float(expected.max() - expected.min())
    assert span > 0.01
    difference = float(np.abs(np.asarray(found) - expected.numpy()).max())
    assert difference <= 1e-4
    assert difference <= 1e-4 * span
