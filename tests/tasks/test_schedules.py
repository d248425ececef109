"""Learning rates of resumed trainings: those of an uninterrupted one, or a refusal."""

from __future__ import annotations

import math
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from torch.optim import lr_scheduler
from transformers import get_scheduler

from tangent_train.callbacks.checkpoints import AtomicCheckpointIO, LastCheckpoint
from tangent_train.errors import SettingError
from tangent_train.tasks import SegmentationTask
from tangent_train.tasks.schedules import Schedule, warmup_cosine
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


def _warm_up_and_cosine(optimizer: Any, epochs: int) -> Any:
    parts = [
        lr_scheduler.LinearLR(optimizer, total_iters=1),
        lr_scheduler.CosineAnnealingLR(optimizer, epochs - 1),
    ]
    return lr_scheduler.SequentialLR(optimizer, parts, milestones=[1])


def _linear_to_zero(optimizer: Any, total_steps: Any) -> Any:
    return lr_scheduler.LambdaLR(optimizer, lambda step: 1 - step / total_steps)


FIXED: dict[str, Any] = {
    "cosine": partial(lr_scheduler.CosineAnnealingLR, T_max=4),
    "cosine with a floor": partial(lr_scheduler.CosineAnnealingLR, T_max=4, eta_min=0.01),
    "cosine to its last epoch": partial(lr_scheduler.CosineAnnealingLR, T_max=3),
    "polynomial": partial(lr_scheduler.PolynomialLR, total_iters=4, power=2),
    "linear": partial(lr_scheduler.LinearLR, start_factor=1, end_factor=0.1, total_iters=4),
    "linear warm-up": partial(lr_scheduler.LinearLR, total_iters=4),
    "one restart": partial(lr_scheduler.CosineAnnealingWarmRestarts, T_0=4),
    "sequence": partial(_warm_up_and_cosine, epochs=4),
    "of every step": Schedule(
        partial(lr_scheduler.OneCycleLR, max_lr=LR, total_steps=None), "step"
    ),
    "function of every step": Schedule(partial(_linear_to_zero, total_steps=None), "step"),
    "warm-up and cosine": Schedule(
        partial(warmup_cosine, warmup_share=0.25, total_steps=_NULL), "step"
    ),
    "of 4 epochs, every other step": Schedule(
        partial(lr_scheduler.CosineAnnealingLR, T_max=6), "step", 2
    ),
    **{
        f"{name} of transformers": partial(
            get_scheduler, name, num_warmup_steps=1, num_training_steps=4
        )
        for name in ("cosine", "linear", "polynomial", "cosine_with_restarts")
    },
}
ENDLESS: dict[str, tuple[Any, Any]] = {
    "none": (None, lambda epoch: 1),
    "constant": (partial(lr_scheduler.ConstantLR, factor=1, total_iters=0), lambda epoch: 1),
    "steps": (
        partial(lr_scheduler.StepLR, step_size=4, gamma=0.5),
        lambda epoch: 0.5 ** (epoch // 4),
    ),
    "exponential": (partial(lr_scheduler.ExponentialLR, gamma=0.5), lambda epoch: 0.5**epoch),
    "milestones": (
        partial(lr_scheduler.MultiStepLR, milestones=[2, 4]),
        lambda epoch: 0.1 ** ((epoch >= 2) + (epoch >= 4)),
    ),
    "a cosine that ends later": (
        partial(lr_scheduler.CosineAnnealingLR, T_max=6),
        lambda epoch: (1 + math.cos(math.pi * epoch / 6)) / 2,
    ),
    "warm-up of transformers": (
        partial(get_scheduler, "constant_with_warmup", num_warmup_steps=2),
        lambda epoch: min(epoch / 2, 1),
    ),
}


@pytest.mark.parametrize("name", FIXED)
def test_a_schedule_of_fixed_length_is_resumed_for_that_length_only(
    name: str, tmp_path: Path
) -> None:
    scheduler = FIXED[name]
    whole = _train(tmp_path / "whole", scheduler, max_epochs=4)
    assert len(set(whole[::STEPS])) >= 3, "it is a schedule"
    begun = _train(tmp_path, scheduler, max_epochs=4, until=2)
    for length in ({"max_epochs": 6}, {"max_epochs": 3}, {"max_epochs": 4, "max_steps": 7}):
        with pytest.raises(SettingError, match=r"max_epochs.*; expected (4|12),.*init_from="):
            _train(tmp_path, scheduler, resume=True, **length)
    rest = _train(tmp_path, scheduler, resume=True, max_epochs=4)
    assert begun + rest == pytest.approx(whole)


@pytest.mark.parametrize("epochs", [6, 3])
@pytest.mark.parametrize("name", ENDLESS)
def test_others_continue_for_longer_or_shorter(name: str, epochs: int, tmp_path: Path) -> None:
    scheduler, factor = ENDLESS[name]
    found = _train(tmp_path, scheduler, max_epochs=4, until=2)
    found += _train(tmp_path, scheduler, resume=True, max_epochs=epochs)
    assert found[::STEPS] == pytest.approx([LR * factor(epoch) for epoch in range(epochs)])


@pytest.mark.parametrize("interval", ["epoch", "step"])
def test_warm_up_and_cosine_have_their_closed_form(interval: Any) -> None:
    length = {"epoch": 8, "step": 24}
    schedule = Schedule(partial(warmup_cosine, warmup_share=0.25, total_steps=_NULL), interval)
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=LR)
    configured = schedule.configure(
        optimizer, lambda: length, [1], "val/miou", SegmentationTask.mode_of
    )
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


@pytest.mark.parametrize("until", [3, 4, 5])
def test_a_plateau_is_resumed_exactly(until: int, tmp_path: Path) -> None:
    plateau: Any = partial(lr_scheduler.ReduceLROnPlateau, mode=_NULL, factor=0.5, patience=1)
    schedule = Schedule(plateau, monitor="val/made")
    more: dict[str, Any] = {"limit_val_batches": 1, "max_epochs": 7}
    whole = _train(tmp_path / "whole", schedule, **more)
    # Better in epoch 1; patience ends after epoch 3 and again after epoch 5.
    assert whole[::STEPS] == pytest.approx([LR * f for f in (1, 1, 1, 1, 0.5, 0.5, 0.25)])
    begun = _train(tmp_path, schedule, until=until, **more | {"max_epochs": 6})
    assert begun + _train(tmp_path, schedule, resume=True, **more) == pytest.approx(whole)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"interval": "day"}, r"scheduler\.interval: found day"),
        ({"frequency": 0}, r"scheduler\.frequency: found 0"),
        ({"monitor": "val/mio"}, r"scheduler\.monitor: found val/mio; expected one of .*val/acc"),
        ({"monitor": "train/los"}, r"scheduler\.monitor: found train/los after epoch 1; .*n/loss"),
        ({"interval": "step"}, r"scheduler\.interval: found step; expected epoch"),
    ],
)
def test_impossible_settings_are_refused(
    settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SettingError, match=message):
        _train(
            tmp_path,
            Schedule(lr_scheduler.ReduceLROnPlateau, **settings),
            max_epochs=1,
            limit_val_batches=1,
        )


def test_a_misspelled_monitor_is_refused_before_training() -> None:
    rates = Rates(None)
    stopping = lightning.pytorch.callbacks.EarlyStopping("val/mio")
    trainer = quiet_trainer(callbacks=[rates, stopping], max_epochs=1, num_sanity_val_steps=1)
    with pytest.raises(SettingError, match=r"monitor of EarlyStopping: .*one of .*val/accuracy"):
        trainer.fit(shape_task(), datamodule=Shapes(3))
    assert not rates.found


@pytest.mark.parametrize("build", [warmup_cosine, partial(lr_scheduler.OneCycleLR, max_lr=LR)])
def test_a_schedule_shorter_than_the_training_is_refused(build: Any, tmp_path: Path) -> None:
    schedule = Schedule(partial(build, total_steps=2 * STEPS - 1), "step")
    with pytest.raises(SettingError, match=r"scheduler\.total_steps: found 5; expected 6 or more"):
        _train(tmp_path, schedule, max_epochs=2)


def test_a_warm_up_that_ends_in_the_first_step_is_refused(tmp_path: Path) -> None:
    one_cycle: Any = partial(lr_scheduler.OneCycleLR, max_lr=LR, total_steps=None, pct_start=1 / 6)
    with pytest.raises(SettingError, match=r"scheduler\.total_steps: found 6; .*pct_start=0\.3"):
        _train(tmp_path, Schedule(one_cycle, "step"), max_epochs=2)


def test_the_length_of_an_endless_training_is_not_made_up(tmp_path: Path) -> None:
    endless = Schedule(partial(warmup_cosine, total_steps=_NULL), "step")
    with pytest.raises(SettingError, match=r"trainer\.max_epochs: found no end"):
        _train(tmp_path, endless, max_epochs=-1)
    given = Schedule(partial(warmup_cosine, warmup_share=0.5, total_steps=4), "step")
    assert _train(tmp_path, given, max_epochs=1)[0] == pytest.approx(0.01 * LR)
