"""The average of the weights is what is validated and kept; training goes on with the weights."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import Callback
from torch import Tensor

from tangent_train.callbacks.checkpoints import (
    AtomicCheckpointIO,
    BestCheckpoint,
    CheckpointContents,
    LastCheckpoint,
    averaged_weights,
)
from tests.tasks.shapes import Shapes, SmallNetwork, quiet_trainer, shape_task

DECAY = 0.3  # from the fourth step on: (1 + t) / (10 + t) is less before
STEPS = 4


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
    reference = Reference()
    task: Any = shape_task(
        SmallNetwork(statistics=True), optimizer=partial(torch.optim.Adam, lr=0.03)
    )
    average = averaged_weights(DECAY, torch.device("cpu"))
    best = BestCheckpoint(tmp_path, "val/class_accuracy")
    contents = CheckpointContents({"config": {}})
    quiet_trainer(
        max_epochs=3,
        enable_checkpointing=True,
        plugins=[AtomicCheckpointIO()],
        callbacks=[average, best, LastCheckpoint(tmp_path), contents, reference],
        accumulate_grad_batches=accumulated,
    ).fit(task, datamodule=Shapes(3 * STEPS))
    assert reference.steps == 3 * STEPS // accumulated
    kept, last = _read(tmp_path / "best.ckpt"), _read(tmp_path / "last.ckpt")
    _assert_close(kept["state_dict"], reference.epochs[kept["epoch"]])
    _assert_close(last["state_dict"], reference.average)
    _assert_close(last["current_model_state"], reference.trained)
    assert kept["state_dict"].keys() == task.state_dict().keys()
    _assert_close(task.state_dict(), reference.average)
    apart = [(value - reference.trained[n]).abs().max() for n, value in reference.average.items()]
    assert max(apart) > 0.01, "the average is another network"
