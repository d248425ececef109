"""Small networks with the numbers of trained ones, and checkpoints as runs write them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from datamodules.core.inputs import Normalization
from tangent_train.checkpoints.loaded import LoadedNetwork, declared_sizes
from tangent_train.cli.run import Run, build
from tangent_train.config.build import build_from_config
from tangent_train.tasks import PixelTask
from tests.inference.trained import TANGENT, trained_network
from tests.running import composed_settings

NAMES = ("unknown", "beam", "board", "sofa", "wall")
UNET = {"_target_": "models.UNet", "in_channels": 4, "num_classes": 4, "widths": [4, 8, 8]}


def with_statistics(network: nn.Module, seed: int = 0) -> nn.Module:
    """Batch statistics as after training: none of them what they are at first."""
    generator = torch.Generator().manual_seed(seed)
    for module in network.modules():
        if isinstance(getattr(module, "running_var", None), torch.Tensor):
            module.running_mean.normal_(0, 0.2, generator=generator)  # type: ignore[operator]
            module.running_var.uniform_(0.5, 2, generator=generator)  # type: ignore[operator]
    return network


def small_trained(
    settings: Mapping[str, Any] = UNET, image_size: tuple[int, int] = (32, 32)
) -> LoadedNetwork:
    """As it comes out of a checkpoint, with random numbers."""
    torch.manual_seed(1)
    network = with_statistics(build_from_config(settings, "network")).eval()
    multiple, fixed = declared_sizes(network)
    return trained_network(
        TANGENT | {"level": 5},
        channels=4,
        module=network,
        class_names=NAMES,
        normalization=Normalization([0.5, 0.4, 0.3, 1.1], [0.2, 0.25, 0.3, 0.8]),
        image_size=image_size,
        size_multiple=multiple,
        fixed_size=fixed,
        fill="edge",
        settings=settings,
        trust=(settings["_target_"],),
    )


def save_checkpoint(path: Path, *overrides: str) -> PixelTask:
    """Write the checkpoint of a run, without entries of Lightning.

    Args:
        path: File to write.
        overrides: Overrides of ``train.yaml``.

    Returns:
        The task in evaluation mode, whose tensors are in the file.
    """
    settings = composed_settings("train", "level=4", *overrides)
    torch.manual_seed(2)
    data, task = build(settings)
    with_statistics(task.network)
    run = Run(path.parent, settings, data, task)
    content = run.contents()
    torch.save(content | {"state_dict": task.state_dict()}, path)
    trained: PixelTask = task.eval()
    return trained
