"""Learning rate schedules: when they are stepped, and what they take from the run."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from torch.optim import Optimizer
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR, SequentialLR

from tangent_train.errors import SettingError
from tangent_train.heads import Head
from tangent_train.tasks.parameter_groups import rates_of


@dataclass(frozen=True)
class Schedule:
    """A learning rate scheduler and Lightning's settings for it.

    Attributes:
        build: Function that builds the scheduler from the optimizer. Arguments that a
            `functools.partial` sets to None are taken from the run: `total_steps` and, for
            `ReduceLROnPlateau`, `mode`.
        interval: Unit after which the scheduler is stepped: ``epoch`` or ``step``. A
            `ReduceLROnPlateau` is stepped after epochs.
        frequency: Number of epochs or steps between steps of the scheduler.
        monitor: Logged value for `ReduceLROnPlateau`; None for the score that selects the best
            epoch.
    """

    build: Callable[..., Any]
    interval: Literal["epoch", "step"] = "epoch"
    frequency: int = 1
    monitor: str | None = None

    def configure(
        self, optimizer: Optimizer, trainer: Any, factors: Sequence[float], monitor: str, head: Head
    ) -> dict[str, Any]:
        """Build the scheduler and Lightning's settings for it.

        Args:
            optimizer: Optimizer whose learning rates are scheduled.
            trainer: Lightning's trainer, for the length of the training.
            factors: Factors of the learning rates of the optimizer's groups.
            monitor: Score that selects the best epoch.
            head: Head of the task, for the direction of the monitored value.

        Raises:
            SettingError: `total_steps` is taken from a training without an end.
        """
        monitored = self.monitor or monitor
        filled: dict[str, Any] = {}
        if set(factors) != {1}:
            filled |= rates_of(self.build, factors)
        if self._is_null("mode"):
            filled["mode"] = head.mode_of(monitored)
        if self._is_null("total_steps"):
            steps = trainer.estimated_stepping_batches
            if not math.isfinite(steps):
                remedy = "Or set scheduler.total_steps."
                raise SettingError(
                    "trainer.max_epochs", found="no end", expected="a number", remedy=remedy
                )
            if self.interval == "epoch":
                per_epoch = trainer.num_training_batches / trainer.accumulate_grad_batches
                steps = math.ceil(steps / max(1, math.ceil(per_epoch)))
            filled["total_steps"] = int(steps) // self.frequency
        return {
            "scheduler": self.build(optimizer, **filled),
            "interval": self.interval,
            "frequency": self.frequency,
            "monitor": monitored,
            # `Task.on_train_epoch_end` steps it.
            "reduce_on_plateau": False,
        }

    def _is_null(self, name: str) -> bool:
        return getattr(self.build, "keywords", {}).get(name, "") is None


def warmup_cosine(
    optimizer: Any,
    total_steps: int,
    warmup_share: float = 0.1,
    start_factor: float = 0.01,
    eta_min: float = 0.0,
) -> SequentialLR:
    """Build a schedule that rises linearly and then falls along half a cosine.

    Args:
        optimizer: Optimizer whose learning rates are scheduled.
        total_steps: Number of steps of the schedule.
        warmup_share: Share of these steps in which the rate rises.
        start_factor: Factor of the learning rate at the start.
        eta_min: Learning rate at the end.
    """
    warmup = max(1, round(warmup_share * total_steps))
    parts = [
        LinearLR(optimizer, start_factor=start_factor, total_iters=warmup),
        CosineAnnealingLR(optimizer, max(1, total_steps - warmup), eta_min=eta_min),
    ]
    return SequentialLR(optimizer, parts, milestones=[warmup])
