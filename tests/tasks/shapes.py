"""Shapes that a small network can learn, as batches of their views."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import lightning
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from datamodules.modelnet40.shapes import ShapeSample
from tangent_train.heads import ImageClassHead
from tangent_train.rendering import TangentRepresentation
from tangent_train.tasks import ShapeTask
from tests.tasks.builders import build_head

NAMES = ("bottle", "chair", "mug")
TANGENT = TangentRepresentation(base_level=0, level=4)


class Spheres(lightning.LightningDataModule):
    """Samples in the lists `train` and `test`; evaluation takes two at a time."""

    def __init__(self, batch_size: int) -> None:
        super().__init__()
        self.batch_size = batch_size
        self.train: Any = []
        self.test: Any = []

    def train_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.train, self.batch_size)

    def val_dataloader(self) -> DataLoader[Any]:
        return DataLoader(self.test, batch_size=2)

    test_dataloader = val_dataloader


class Shapes(Spheres):
    """Shapes whose class is the brightest channel of one of their views, under noise.

    Args:
        count: Number of shapes; shape k is of class k % 3.
        batch_size: Number of shapes in a training batch; evaluation takes two at a time.
    """

    labels = "image_class"

    def __init__(self, count: int = 9, batch_size: int = 3) -> None:
        super().__init__(batch_size)
        generator = torch.Generator().manual_seed(0)
        self.shapes: list[ShapeSample] = []
        for index in range(count):
            images = 0.3 * torch.randn(5, 3, 16, 16, generator=generator)
            images[index % 5, index % 3] += 2
            self.shapes.append(ShapeSample(images, torch.tensor(index % 3), torch.tensor(index)))
        self.train = self.test = self.shapes


class SmallNetwork(nn.Module):
    """Without batch statistics, a gradient does not depend on what is computed together.

    With batch statistics, biases before them would have gradients of rounding errors only.
    """

    def __init__(self, classes: int = 3, *, statistics: bool = False) -> None:
        super().__init__()
        norm: Any = nn.BatchNorm2d if statistics else partial(nn.GroupNorm, 2)
        self.encoder = nn.Sequential(
            nn.Conv2d(3, 8, 3, stride=2, bias=not statistics), norm(8), nn.ReLU()
        )
        self.neck = nn.Sequential(nn.Conv2d(8, 8, 1, bias=not statistics), norm(8), nn.ReLU())
        self.head = nn.Linear(8, classes)

    def forward(self, images: Tensor) -> Tensor:
        features = self.neck(self.encoder(images.flatten(0, 1))).mean(dim=(2, 3))
        scores: Tensor = self.head(features.unflatten(0, images.shape[:2]).mean(dim=1))
        return scores


def shape_task(
    network: nn.Module | None = None, names: Sequence[str] = NAMES, **settings: Any
) -> ShapeTask:
    """A task on shapes; the same small network at every call."""
    torch.manual_seed(0)
    optimizer = settings.pop("optimizer", partial(torch.optim.SGD, lr=0.1))
    head = build_head(ImageClassHead, names, settings)
    return ShapeTask(network or SmallNetwork(), TANGENT, head, optimizer, **settings)


class Gradients(lightning.Callback):
    """Keeps the gradients that the optimizer has used."""

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        self.found = [p.grad.clone() for p in pl_module.parameters()]
        self.loss = trainer.callback_metrics["train/loss"]


def quiet_trainer(**settings: Any) -> lightning.Trainer:
    """A trainer that writes and prints nothing."""
    quiet: dict[str, Any] = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
        "accelerator": "cpu",
        "num_sanity_val_steps": 0,
        "use_distributed_sampler": False,
    }
    return lightning.Trainer(**(quiet | settings))


def gradients_of(
    task: lightning.LightningModule, data: lightning.LightningDataModule, **trainer: Any
) -> Gradients:
    """The gradients and the loss of the last step of an epoch."""
    kept = Gradients()
    callbacks = [kept, *trainer.pop("callbacks", [])]
    trainer = {"max_epochs": 1, "limit_val_batches": 0, "callbacks": callbacks} | trainer
    quiet_trainer(**trainer).fit(task, datamodule=data)
    return kept
