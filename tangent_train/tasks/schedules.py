"""Learning rates over a training."""

from __future__ import annotations

import math

from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from tangent_train.errors import SettingError
from tangent_train.registry import registered

__all__ = ["WarmupCosineLR"]


@registered
class WarmupCosineLR(LRScheduler):
    """Rises in a straight line to the learning rate, then falls along half a cosine to zero.

    Nothing but the learning rate changes: torch's `OneCycleLR` also moves the momentum (of Adam β₁)
    from 0.95 to 0.85 and back, whatever the optimizer was given, and cannot warm up for exactly one
    step.

    Args:
        optimizer: Whose learning rates to set; what they are now is where they rise to.
        total_steps: Steps of the whole training.
        warmup: Share of them in which the rate rises.

    Raises:
        SettingError: The share is not at least 0 and below 1.
    """

    def __init__(self, optimizer: Optimizer, total_steps: int, warmup: float = 0.05) -> None:
        if not 0 <= warmup < 1:
            raise SettingError("scheduler.warmup", found=warmup, expected="0 or more, below 1")
        self.total_steps = total_steps
        # Some step has the full rate.
        self.warmup_steps = min(round(warmup * total_steps), max(total_steps - 1, 0))
        super().__init__(optimizer)

    def get_lr(self) -> list[float | Tensor]:
        """Of the next step, for every group of parameters."""
        factor = self._factor(self.last_epoch)
        return [rate * factor for rate in self.base_lrs]

    def _factor(self, step: int) -> float:
        if step < self.warmup_steps:
            return (step + 1) / (self.warmup_steps + 1)
        falling = max(self.total_steps - self.warmup_steps, 1)
        return (1 + math.cos(math.pi * min((step - self.warmup_steps) / falling, 1))) / 2
