"""The average of the weights is what is validated and kept; training goes on with the weights."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning.pytorch.callbacks import Callback, EMAWeightAveraging
from torch import Tensor

from tangent_train.callbacks.checkpoints import (
    AtomicCheckpointIO,
    BestCheckpoint,
    CheckpointContents,
    LastCheckpoint,
)
from tests.tasks.shapes import Shapes, SmallNetwork, quiet_trainer, shape_task

DECAY = 0.3
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
        now = {n: v.detach().double().clone() for n, v in _numbers(pl_module.state_dict()).items()}
        for name, value in now.items():
            self.average[name] = DECAY * self.average.get(name, value) + (1 - DECAY) * value
        self.steps += 1
        self.trained = now

    def on_train_epoch_end(self, trainer: Any, pl_module: Any) -> None:
        self.epochs.append(dict(self.average))


def _read(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = torch.load(path, weights_only=True)
    return content


def _numbers(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """All but the counts of batches, whose averages are rounded."""
    return {name: value for name, value in state.items() if value.is_floating_point()}


def _assert_close(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    found = {name: value.double() for name, value in _numbers(found).items()}
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("accumulated", [1, 2])
def test_checkpoints_hold_the_average_and_the_weights_to_go_on_with(
    tmp_path: Path, accumulated: int
) -> None:
    reference = Reference()
    task: Any = shape_task(
        SmallNetwork(statistics=True), optimizer=partial(torch.optim.Adam, lr=0.03)
    )
    average = EMAWeightAveraging(decay=DECAY)
    best = BestCheckpoint(tmp_path, "val/class_accuracy", "max")
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
