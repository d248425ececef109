from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader

from tangent_train.callbacks.checkpoints import (
    AtomicCheckpointIO,
    BestCheckpoint,
    CheckpointContents,
    LastCheckpoint,
    averaged_weights,
)
from tests.tasks.shapes import quiet_trainer

DECAY = 0.3  # from the fourth step on: (1 + t) / (10 + t) is less before
STEPS = 4

pytestmark = [
    pytest.mark.filterwarnings("ignore:Checkpoint directory .* exists and is not empty"),
    # All batches are the same.
    pytest.mark.filterwarnings("ignore:.* your dataloader is not resumable"),
]


class Learner(lightning.LightningModule):
    """Batch statistics, and dropout that draws from torch's generator at every step."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.network = nn.Sequential(
            nn.Conv2d(2, 4, 3), nn.BatchNorm2d(4), nn.Dropout(0.3), nn.Conv2d(4, 3, 1)
        )
        self.register_buffer("weights", torch.ones(3))

    def setup(self, stage: str) -> None:
        if stage == "fit":  # by then Lightning has copied the module
            self.weights = torch.tensor([0.0, 1.0, 3.0])

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        images, labels = batch
        return functional.cross_entropy(self.network(images), labels, self.weights)

    def validation_step(self, batch: Any, batch_idx: int) -> None:
        # Falls from epoch to epoch: the first is the best.
        self.log("val/miou", self.training_step(batch, batch_idx), sync_dist=True)

    def configure_optimizers(self) -> Any:
        return torch.optim.Adam(self.parameters(), lr=0.03)

    def train_dataloader(self) -> DataLoader[Any]:
        return _loader(_data() * STEPS)

    def val_dataloader(self) -> DataLoader[Any]:
        return _loader(_data())


def _loader(samples: Any) -> DataLoader[Any]:
    # A generator of its own: loaders draw from torch's, which dropout shall have to itself.
    return DataLoader(samples, batch_size=6, generator=torch.Generator())


def _data() -> Any:
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(6, 2, 8, 8, generator=generator)
    labels = torch.randint(1, 3, (6, 6, 6), generator=generator)
    return list(zip(images, labels, strict=True))


class Reference(Callback):
    """The average by its definition, of every tensor in float64, after every step and epoch."""

    def __init__(self) -> None:
        self.steps = 0
        self.average: dict[str, Tensor] = {}
        self.epochs: list[dict[str, Tensor]] = []

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        if trainer.global_step == self.steps:
            return  # accumulated
        now = {n: v.detach().double().clone() for n, v in pl_module.state_dict().items()}
        decay = min(DECAY, (1 + self.steps) / (10 + self.steps)) if self.steps else 0.0
        for name, value in now.items():
            whole = name.endswith("num_batches_tracked")
            old = self.average.get(name, value)
            self.average[name] = value if whole else decay * old + (1 - decay) * value
        self.steps += 1
        self.trained = now

    def on_train_epoch_end(self, trainer: Any, pl_module: Any) -> None:
        self.epochs.append(dict(self.average))


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


def _assert_close(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    found = {name: value.double() for name, value in found.items()}
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("accumulated", [1, 2])
def test_checkpoints_hold_the_average_and_the_weights_to_go_on_with(
    tmp_path: Path, accumulated: int
) -> None:
    reference, learner = Reference(), Learner()
    average = averaged_weights(DECAY, torch.device("cpu"))
    contents = CheckpointContents({"config": {}})
    checkpoints = [BestCheckpoint(tmp_path), LastCheckpoint(tmp_path), contents]
    quiet_trainer(
        max_epochs=3,
        enable_checkpointing=True,
        plugins=[AtomicCheckpointIO()],
        callbacks=[average, *checkpoints, reference],
        accumulate_grad_batches=accumulated,
    ).fit(learner)
    assert reference.steps == 3 * STEPS // accumulated
    best, last = _read(tmp_path / "best.ckpt"), _read(tmp_path / "last.ckpt")
    _assert_close(best["state_dict"], reference.epochs[0])
    _assert_close(last["state_dict"], reference.average)
    _assert_close(last["current_model_state"], reference.trained)
    assert best["state_dict"].keys() == learner.state_dict().keys()
    _assert_close(learner.state_dict(), reference.average)
    apart = [(value - reference.trained[n]).abs().max() for n, value in reference.average.items()]
    assert max(apart) > 0.01, "the average is another network"
