"""Imported photo networks, as `tangent-import` writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from datamodules.core.inputs import Normalization
from tangent_train.inference.photo_networks import PhotoNetwork, import_network
from tangent_train.registry import make
from tests.tasks.small_networks import with_statistics

UNET = {"_target_": "models.UNet", "in_channels": 3, "num_classes": 21, "widths": [4, 8, 12]}


def write_imported(path: Path, settings: dict[str, Any] = UNET, classes: int = 21) -> Path:
    """Write a network with random numbers, of ``imagenet`` normalization."""
    torch.manual_seed(3)
    network = with_statistics(make(settings, "network"))
    names = [f"thing {number}" for number in range(classes)]
    normalization = Normalization.of("imagenet", 3)
    photo = PhotoNetwork(network, settings, names, normalization, (64, 64))
    import_network(photo, path, level=6)
    return path
