"""A resumed training ends as an uninterrupted one, and keeps its best epoch."""

from __future__ import annotations

import os
import signal
from collections import defaultdict
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import pytest
import torch
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor, nn

from tangent_train.callbacks.checkpoints import (
    AtomicCheckpointIO,
    BestCheckpoint,
    CheckpointContents,
    LastCheckpoint,
)
from tests.tasks.shapes import Shapes, SmallNetwork, quiet_trainer, shape_task

pytestmark = pytest.mark.filterwarnings(
    "ignore:You defined a `validation_step`:UserWarning",
    "ignore:.*is not resumable",
    "ignore:Checkpoint directory",
)


class Dropping(SmallNetwork):
    """With dropout, which depends on the random state of torch."""

    def forward(self, images: Tensor) -> Tensor:
        return super().forward(nn.functional.dropout(images, 0.5, self.training))


class End(lightning.Callback):
    """Sends a signal after a batch, counted over epochs."""

    def __init__(self, batch: int | None, number: int) -> None:
        self.batch, self.number, self.count = batch, number, 0

    def state_dict(self) -> dict[str, Any]:
        """Plain values of a user's callback."""
        return {"best": np.float64(0.5), "of": defaultdict(int, a=1)}

    def on_train_batch_end(self, *_: Any) -> None:
        self.count += 1
        if self.count == self.batch:
            os.kill(os.getpid(), self.number)


def _train(
    folder: Path, batch: int | None, number: int = signal.SIGTERM, *, resume: bool = False
) -> dict[str, Tensor]:
    torch.manual_seed(3)
    network, data = Dropping(), Shapes(batch_size=2)
    data.train = data.shapes[:2] * 5  # equal batches, apart from dropout
    task = shape_task(network)
    torch.manual_seed(5 + resume)
    callbacks = [End(batch, number), CheckpointContents({}), LastCheckpoint(folder, 1)]
    trainer = quiet_trainer(
        callbacks=callbacks,
        enable_checkpointing=True,
        default_root_dir=folder,
        limit_val_batches=0,
        accumulate_grad_batches=2,
        max_epochs=2,
        plugins=[AtomicCheckpointIO()],
    )
    if batch is None:
        trainer.fit(task, datamodule=data, **_from(folder) if resume else {})
    else:
        with pytest.raises(SIGTERMException) as ended:
            trainer.fit(task, datamodule=data)
        assert ended.value.args == (number,)
    return {name: tensor.clone() for name, tensor in task.network.state_dict().items()}


def _from(folder: Path) -> dict[str, Any]:
    return {"ckpt_path": folder / "last.ckpt", "weights_only": True}


@pytest.mark.parametrize(
    ("batch", "number"), [(1, signal.SIGTERM), (3, signal.SIGHUP), (6, signal.SIGTERM)]
)
def test_a_signal_amid_accumulated_batches_loses_nothing(
    batch: int, number: int, tmp_path: Path
) -> None:
    """An epoch has 5 batches, 2 per step; dropout goes on from the same random state."""
    whole = _train(tmp_path / "whole", None)
    _train(tmp_path, batch, number)
    found = _train(tmp_path, None, resume=True)
    torch.testing.assert_close(found, whole, rtol=0, atol=0)


def test_a_hangup_that_nohup_ignores_stays_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        task, last = shape_task(), LastCheckpoint(tmp_path)
        callbacks = [End(1, signal.SIGHUP), last]
        quiet_trainer(
            callbacks=callbacks, enable_checkpointing=True, max_epochs=1, limit_val_batches=0
        ).fit(task, datamodule=Shapes())
    finally:
        signal.signal(signal.SIGHUP, before)


class Scored(lightning.Callback):
    """Logs a given score after each epoch."""

    def on_validation_epoch_end(self, trainer: Any, pl_module: Any) -> None:
        pl_module.log("val/made", (0.9, 0.5, 0.7)[trainer.current_epoch])


def test_a_resumed_run_keeps_a_better_epoch_from_before(tmp_path: Path) -> None:
    for epochs in (2, 3):
        best = BestCheckpoint(tmp_path, "val/made", "max")
        trainer = quiet_trainer(
            callbacks=[Scored(), LastCheckpoint(tmp_path), best],
            enable_checkpointing=True,
            max_epochs=epochs,
            limit_val_batches=1,
        )
        more = _from(tmp_path) if epochs == 3 else {}
        trainer.fit(shape_task(), datamodule=Shapes(), **more)
    content = torch.load(tmp_path / "best.ckpt", weights_only=True)
    assert content["epoch"] == 0
    assert best.best_model_score == pytest.approx(0.9)
