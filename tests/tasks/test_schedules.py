"""Learning rates of resumed trainings: those of an uninterrupted one, or a refusal."""

from __future__ import annotations

import math
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning
import pytest
import torch
from torch.optim import lr_scheduler

from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, LastCheckpoint
from tangent_train.errors import SettingError
from tangent_train.tasks.optimization import Schedule, warmup_cosine
from tests.tasks.shapes import Shapes, quiet_trainer, shape_task

LR = 0.1
_NULL: Any = None  # in a config: the length of the training
STEPS = 3  # of an epoch


class CutError(Exception):
    """Ends a training."""


class Rates(lightning.Callback):
    """Keeps the learning rate of every step; ends the training after some epochs."""

    def __init__(self, until: int | None) -> None:
        self.found: list[float] = []
        self.until = until

    def on_train_epoch_start(self, trainer: Any, *_: Any) -> None:
        if trainer.current_epoch == self.until:
            raise CutError

    def on_train_batch_start(self, trainer: Any, *_: Any) -> None:
        self.found.append(trainer.optimizers[0].param_groups[0]["lr"])


def _train(
    folder: Path, scheduler: Any, *, resume: bool = False, until: int | None = None, **trainer: Any
) -> list[float]:
    """The learning rate of every step."""
    rates = Rates(until)
    task = shape_task(scheduler=scheduler, optimizer=partial(torch.optim.SGD, lr=LR, momentum=0.9))
    made = quiet_trainer(
        callbacks=[rates, LastCheckpoint(folder), Scores()],
        enable_checkpointing=True,
        plugins=[AtomicCheckpointIO()],
        **{"limit_val_batches": 0, **trainer},
    )
    path = folder / "last.ckpt" if resume else None
    with nullcontext() if until is None else pytest.raises(CutError):
        made.fit(task, datamodule=Shapes(3 * STEPS), ckpt_path=path, weights_only=True)
    return rates.found


SCHEDULES: dict[str, Any] = {
    "none": None,
    "steps": partial(lr_scheduler.StepLR, step_size=1, gamma=0.5),
    "warm-up and cosine": Schedule(
        partial(warmup_cosine, warmup_share=0.25, total_steps=_NULL), "step"
    ),
    "every other step": Schedule(partial(lr_scheduler.CosineAnnealingLR, T_max=6), "step", 2),
}


@pytest.mark.parametrize("name", SCHEDULES)
def test_a_resumed_schedule_continues_as_if_it_had_not_stopped(name: str, tmp_path: Path) -> None:
    scheduler = SCHEDULES[name]
    whole = _train(tmp_path / "whole", scheduler, max_epochs=4)
    assert len(set(whole[::STEPS])) >= 3 or scheduler is None
    begun = _train(tmp_path, scheduler, max_epochs=4, until=2)
    rest = _train(tmp_path, scheduler, resume=True, max_epochs=4)
    assert begun + rest == pytest.approx(whole)


@pytest.mark.parametrize(
    ("schedule", "length"),
    [
        (Schedule(partial(warmup_cosine, total_steps=_NULL), "step"), 6),
        (partial(lr_scheduler.CosineAnnealingLR, T_max=2), 2),
    ],
)
def test_a_schedule_with_an_end_is_not_resumed_for_another_length(
    schedule: Any, length: int, tmp_path: Path
) -> None:
    """Before the first step; with the same length, a finished training resumes."""
    _train(tmp_path, schedule, max_epochs=2)
    assert _train(tmp_path, schedule, resume=True, max_epochs=2) == []
    with pytest.raises(SettingError, match=f"found .*; expected {length}, when resuming"):
        _train(tmp_path, schedule, resume=True, max_epochs=3)


def test_the_number_of_warm_up_steps_is_rounded() -> None:
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=LR)
    schedule = warmup_cosine(optimizer, total_steps=11, warmup_share=0.25)  # 2.75
    rates = []
    for _ in range(4):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates == pytest.approx([LR * (0.01 + 0.99 * step / 3) for step in range(4)])


@pytest.mark.parametrize("interval", ["epoch", "step"])
def test_warm_up_and_cosine_have_their_closed_form(interval: Any) -> None:
    length = {"epoch": 8, "step": 24}
    trainer = SimpleNamespace(
        estimated_stepping_batches=24, num_training_batches=3, accumulate_grad_batches=1
    )
    schedule = Schedule(partial(warmup_cosine, warmup_share=0.25, total_steps=_NULL), interval)
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=LR)
    configured = schedule.configure(optimizer, trainer, "val/miou", str)
    total = length[interval]
    for step in range(total + 1):
        rise = 0.01 + 0.99 * step / (total / 4)
        fall = (1 + math.cos(math.pi * (step - total / 4) / (total * 3 / 4))) / 2
        expected = LR * (rise if step <= total / 4 else fall)
        assert optimizer.param_groups[0]["lr"] == pytest.approx(expected, abs=1e-9), step
        optimizer.step()
        configured["scheduler"].step()


class Scores(lightning.Callback):
    """Logs a made score after every validation; the best is the second one."""

    def on_validation_epoch_end(self, trainer: Any, pl_module: Any) -> None:
        pl_module.log("val/made", float(trainer.current_epoch == 1))


@pytest.mark.parametrize("until", [3, 5])
def test_a_plateau_is_resumed_exactly(until: int, tmp_path: Path) -> None:
    plateau: Any = partial(lr_scheduler.ReduceLROnPlateau, mode=_NULL, factor=0.5, patience=1)
    schedule = Schedule(plateau, monitor="val/made")
    more: dict[str, Any] = {"limit_val_batches": 1, "max_epochs": 7}
    whole = _train(tmp_path / "whole", schedule, **more)
    # Better in epoch 1; patience ends after epoch 3 and again after epoch 5.
    assert whole[::STEPS] == pytest.approx([LR * f for f in (1, 1, 1, 1, 0.5, 0.5, 0.25)])
    begun = _train(tmp_path, schedule, until=until, **more | {"max_epochs": 6})
    assert begun + _train(tmp_path, schedule, resume=True, **more) == pytest.approx(whole)


def test_a_plateau_is_stepped_after_every_nth_epoch(tmp_path: Path) -> None:
    """After epochs 1, 3 and 5; the score is best in epoch 1."""
    plateau: Any = partial(lr_scheduler.ReduceLROnPlateau, mode=_NULL, factor=0.5, patience=0)
    schedule = Schedule(plateau, frequency=2, monitor="val/made")
    more: dict[str, Any] = {"limit_val_batches": 1, "max_epochs": 6, "check_val_every_n_epoch": 2}
    rates = _train(tmp_path, schedule, **more)
    assert rates[::STEPS] == pytest.approx([LR, LR, LR, LR, LR / 2, LR / 2])
