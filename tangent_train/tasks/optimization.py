"""Learning rates and their schedules, and parts of a network that are not trained."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any, Literal

from torch import nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR, SequentialLR

from tangent_train.errors import SettingError

_RATES = ("max_lr", "base_lr")
"""Arguments with which schedulers replace the learning rate of the optimizer."""


def freeze(network: nn.Module, names: Iterable[str]) -> list[nn.Module]:
    """Exclude parts of a network from training.

    Args:
        network: Network, changed in place: parameters of these parts need no gradient.
        names: Full names of modules or parameters in the network.

    Returns:
        Frozen modules, in evaluation mode, which keeps their batch statistics unchanged.

    Raises:
        SettingError: A part does not exist.
    """
    modules, parameters = dict(network.named_modules()), dict(network.named_parameters())
    if unknown := set(names) - modules.keys() - parameters.keys():
        examples = ", ".join(child for child, _ in network.named_children())
        expected = f"modules or parameters, such as {examples}"
        raise SettingError("task.frozen", found=", ".join(sorted(unknown)), expected=expected)
    for name in parameters.keys() & set(names):
        parameters[name].requires_grad_(False)
    return [modules[name].requires_grad_(False).eval() for name in names if name in modules]


def parameter_groups(
    network: nn.Module, fresh: Collection[str], backbone_factor: float
) -> list[dict[str, Any]]:
    """Return groups for an optimizer: ``backbone``, the loaded parameters, and ``new``, the others.

    Args:
        network: Network; parameters that need no gradient are left out.
        fresh: Names of tensors that were not loaded.
        backbone_factor: Factor of the learning rate of the loaded ones; 1 for a single group.
    """
    trained = {name: p for name, p in network.named_parameters() if p.requires_grad}
    if backbone_factor == 1:
        return [{"params": list(trained.values())}]
    new = [parameter for name, parameter in trained.items() if name in fresh]
    loaded = [parameter for name, parameter in trained.items() if name not in fresh]
    groups: list[dict[str, Any]] = [
        {"params": loaded, "name": "backbone", "lr_factor": backbone_factor},
        {"params": new, "name": "new"},
    ]
    return [group for group in groups if group["params"]]


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

    def length(self, trainer: Any) -> Any:
        """Return the epochs or steps of the schedule; None if it has no end."""
        if {"T_max", "total_steps"}.isdisjoint(getattr(self.build, "keywords", {})):
            return None
        steps = trainer.estimated_stepping_batches
        per_epoch = trainer.num_training_batches / trainer.accumulate_grad_batches  # may be inf
        if self.interval == "step" or math.isinf(per_epoch):
            return steps
        return math.ceil(steps / max(1, math.ceil(per_epoch)))

    def configure(
        self, optimizer: Optimizer, trainer: Any, monitor: str, mode_of: Callable[[str], str]
    ) -> dict[str, Any]:
        """Build the scheduler and Lightning's settings for it.

        Args:
            optimizer: Optimizer whose learning rates are scheduled; groups of parameters may have
                an ``lr_factor``.
            trainer: Lightning's trainer, for the length of the training.
            monitor: Score that selects the best epoch.
            mode_of: Returns the direction of a logged value, see `Head.mode_of`.
        """
        settings: dict[str, Any] = getattr(self.build, "keywords", {})
        filled: dict[str, Any] = {}
        monitored = self.monitor or monitor
        factors = [group.get("lr_factor", 1) for group in optimizer.param_groups]
        if set(factors) != {1}:
            rates = {name: settings[name] for name in _RATES if name in settings}
            filled = {name: [rate * factor for factor in factors] for name, rate in rates.items()}
        if "mode" in settings and settings["mode"] is None:
            filled["mode"] = mode_of(monitored)
        if "total_steps" in settings and settings["total_steps"] is None:
            filled["total_steps"] = int(self.length(trainer)) // self.frequency
        return {
            "scheduler": self.build(optimizer, **filled),
            "interval": self.interval,
            "frequency": self.frequency,
            "monitor": monitored,
            # `Task.on_train_epoch_end` steps it.
            "reduce_on_plateau": False,
        }


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
