"""Learning rate schedules: when they are stepped, and the length of training that they need."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch.optim import Optimizer
from torch.optim.lr_scheduler import (
    CosineAnnealingLR,
    LinearLR,
    ReduceLROnPlateau,
    SequentialLR,
)

from tangent_train.errors import SettingError, at_least
from tangent_train.tasks.parameter_groups import rates_of


@dataclass(frozen=True)
class Schedule:
    """A learning rate scheduler and Lightning's settings for it.

    Attributes:
        build: Function that builds the scheduler from the optimizer. Arguments that a
            `functools.partial` sets to None are taken from the run: `total_steps` and, for
            `ReduceLROnPlateau`, `mode`.
        interval: Unit after which the scheduler is stepped: ``epoch`` or ``step``.
        frequency: Number of epochs or steps between steps of the scheduler.
        monitor: Logged value for `ReduceLROnPlateau`; None for the score that selects the best
            epoch.

    Raises:
        SettingError: A setting is invalid.
    """

    build: Callable[..., Any]
    interval: Literal["epoch", "step"] = "epoch"
    frequency: int = 1
    monitor: str | None = None

    def __post_init__(self) -> None:
        at_least("scheduler.frequency", self.frequency, 1)
        if self.interval not in ("epoch", "step"):
            expected = "epoch or step"
            raise SettingError("scheduler.interval", found=self.interval, expected=expected)

    @property
    def has_length_of_training(self) -> bool:
        """True if `total_steps` is taken from the run."""
        return self._is_null("total_steps")

    def configure(
        self,
        optimizer: Optimizer,
        length: Callable[[], Mapping[str, int]],
        factors: Sequence[float],
        monitor: str,
        mode_of: Callable[[str], str],
    ) -> dict[str, Any]:
        """Build the scheduler and Lightning's settings for it.

        Args:
            optimizer: Optimizer whose learning rates are scheduled.
            length: Function that returns the number of epochs and steps of the training.
            factors: Factors of the learning rates of the optimizer's groups.
            monitor: Score that selects the best epoch.
            mode_of: Function that returns ``max`` or ``min`` for a logged value.

        Raises:
            SettingError: The training has no end, or `ReduceLROnPlateau` is stepped every step.
        """
        filled: dict[str, Any] = {}
        if set(factors) != {1}:
            filled |= rates_of(self.build, factors)
        if self.has_length_of_training:
            filled["total_steps"] = length()[self.interval] // self.frequency
            if filled["total_steps"] < 1:
                remedy = "Or set scheduler.total_steps."
                raise SettingError(
                    "trainer.max_epochs", found="no end", expected="a number", remedy=remedy
                )
        monitored = self.monitor or monitor
        if self._is_null("mode"):
            filled["mode"] = mode_of(monitored)
        try:
            scheduler = self.build(optimizer, **filled)
        except ZeroDivisionError as error:
            raise SettingError(
                "scheduler.total_steps",
                found=filled.get("total_steps", "a number"),
                expected="another number: the warm-up would end in the first step",
                remedy="Set scheduler.pct_start=0.3, or another trainer.max_epochs.",
            ) from error
        if isinstance(scheduler, ReduceLROnPlateau) and self.interval == "step":
            expected = "epoch for ReduceLROnPlateau: a resumed run has no value of the last step"
            raise SettingError("scheduler.interval", found="step", expected=expected)
        return {
            "scheduler": scheduler,
            "interval": self.interval,
            "frequency": self.frequency,
            "monitor": monitored,
            # `Task.on_train_epoch_end` steps it.
            "reduce_on_plateau": False,
        }

    def check_length(self, length: Mapping[str, int]) -> None:
        """Refuse a `total_steps` from the user that is less than the length of the training.

        Args:
            length: Number of epochs and steps of the training.

        Raises:
            SettingError: The schedule ends before the training.
        """
        total = getattr(self.build, "keywords", {}).get("total_steps")
        steps = length[self.interval] // self.frequency
        if isinstance(total, int) and total < steps:
            raise SettingError(
                "scheduler.total_steps",
                found=total,
                expected=f"{steps} or more, the length of the training, or null",
                remedy="A smaller number would end the schedule before the training.",
            )

    def ends_at(self, length: int, make_optimizer: Callable[..., Any]) -> bool:
        """Return True if the schedule was made for a length of training.

        The learning rate of such a schedule changes in the last epochs, and then stays constant or
        reverses its direction, at the end of the training or one epoch before. This does not depend
        on the names of the scheduler's settings.

        Args:
            length: Number of epochs or steps; negative for a training without an end.
            make_optimizer: Function that builds the optimizer from parameters.
        """
        if self._is_null("mode"):  # `ReduceLROnPlateau`, which has no length
            return False
        optimizer = make_optimizer([{"params": [torch.zeros(1, requires_grad=True)]}])
        scheduler = self.build(optimizer)
        if isinstance(scheduler, ReduceLROnPlateau):
            return False
        count = length // self.frequency
        rates = [optimizer.param_groups[0]["lr"]]
        for _ in range(2 * count + 1):
            optimizer.step(lambda: 0.0)  # some optimizers need a closure
            scheduler.step()
            rates.append(optimizer.param_groups[0]["lr"])
        changes = [after - before for before, after in itertools.pairwise(rates)]
        return any(
            all(changes[max(end - 2, 0) : end])
            and (not any(changes[end:]) or changes[end - 1] * changes[end] < 0)
            for end in (count - 1, count)
            if end > 0
        )

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

    Raises:
        SettingError: `warmup_share` is negative, or not less than 1.
    """
    if not 0 <= warmup_share < 1:
        expected = "0 or more, less than 1"
        raise SettingError("scheduler.warmup_share", found=warmup_share, expected=expected)
    warmup = max(1, round(warmup_share * total_steps))
    parts = [
        LinearLR(optimizer, start_factor=start_factor, total_iters=warmup),
        CosineAnnealingLR(optimizer, max(1, total_steps - warmup), eta_min=eta_min),
    ]
    return SequentialLR(optimizer, parts, milestones=[warmup])
