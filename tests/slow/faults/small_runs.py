"""Small trainings on files in the real format, whose network can be made to fail."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import Tensor, nn

from datamodules.stanford2d3ds.files import CLASSES
from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, LastCheckpoint
from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import PixelTask
from tests.tasks.builders import segmentation_task
from tests.tasks.shapes import quiet_trainer


class Faulty(nn.Module):
    """A small network without batch statistics that does something wrong in one forward pass.

    Args:
        at: Number of the forward pass in training, from 0.
        wrong: Function that damages the scores of this pass.
    """

    def __init__(
        self, at: int = -1, wrong: Callable[[Tensor], Tensor] = lambda scores: scores * torch.nan
    ) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer = nn.Conv2d(3, 13, 3, padding=1)
        self.at = at
        self.wrong = wrong
        self.seen: list[Tensor] = []
        self.weights: list[Tensor] = []

    def forward(self, images: Tensor) -> Tensor:
        scores: Tensor = self.layer(images)
        if not self.training:
            return scores
        self.seen.append(images.detach().clone())
        self.weights.append(self.layer.weight.detach().clone())
        return self.wrong(scores) if len(self.seen) - 1 == self.at else scores


def small_task(network: nn.Module, **settings: Any) -> PixelTask:
    """A task on tangent images of the classes of Stanford2D3DS."""
    return segmentation_task(
        network,
        TangentRepresentation(base_level=0, level=4),
        ("unknown", *CLASSES),
        partial(torch.optim.SGD, lr=0.01),
        class_weights="none",
        **settings,
    )


def small_data(root: Path, **settings: Any) -> Stanford2D3DS:
    """RGB panoramas of 32×64 in the format of Stanford2D3DS."""
    representation = TangentRepresentation(base_level=0, level=4)
    return Stanford2D3DS(root, representation, inputs=["rgb"], batch_size=1, **settings)


def run_trainer(
    folder: Path,
    *,
    checkpoint_every: int | None = None,
    callbacks: Sequence[lightning.Callback] = (),
    plugins: Sequence[Any] = (),
    **settings: Any,
) -> lightning.Trainer:
    """As runs make it, in a folder, without its pictures."""
    return quiet_trainer(
        default_root_dir=str(folder),
        enable_checkpointing=True,
        limit_val_batches=0,
        callbacks=[*callbacks, LastCheckpoint(folder / "checkpoints", checkpoint_every)],
        plugins=[AtomicCheckpointIO(), *plugins],
        **settings,
    )
