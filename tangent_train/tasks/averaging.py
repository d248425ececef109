"""The exponential moving average of the weights of a training."""

from __future__ import annotations

from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from tangent_train.errors import SettingError

__all__ = ["AveragedWeights"]


class AveragedWeights(WeightAveraging):
    """Keeps the average of the weights after every step; what is validated and kept is the average.

    After t steps the average moves by ``1 − min(decay, (1 + t) / (10 + t))`` towards the weights:
    at first it forgets quickly where they came from, so a short training averages about its last
    tenth, a long one its last ``1 / (1 − decay)`` steps. Statistics of batch normalization are
    averaged alike.

    The ``state_dict`` of every checkpoint is the average, under the usual names, so evaluation,
    prediction, export and ``init_from`` use it and know nothing of it; beside it are the weights as
    trained, with which a resumed run goes on.

    Lightning's callback, with three changes. The average is on the device of the training: at
    `setup`, when Lightning asks where the weights are, they are still on the CPU, and every step
    would fetch them. Counts of batches are copied: averaged as whole numbers, they never grow. The
    average ends with the training: a validation of other weights later would get it instead.

    Args:
        decay: Share of the average that a step leaves, such as 0.999.

    Raises:
        SettingError: It is not between 0 and 1.
    """

    def __init__(self, decay: float) -> None:
        if not isinstance(decay, float) or not 0 < decay < 1:
            raise SettingError(
                "ema", found=repr(decay), expected="a decay between 0 and 1, as 0.999, or null"
            )
        super().__init__(multi_avg_fn=self._move)
        self.decay = decay

    def setup(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str
    ) -> None:
        """Make the average when a training begins."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:  # asked for at every step: not to wait for a GPU
            self._average_model.n_averaged = torch.tensor(0)

    def on_fit_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Refuse weights that cannot be averaged.

        Raises:
            SettingError: They are of half precision.
        """
        if any(p.dtype in (torch.float16, torch.bfloat16) for p in pl_module.parameters()):
            raise SettingError(
                "trainer.precision, with ema",
                found=trainer.precision,
                expected="weights of 32 bits: steps as small as those of an average are lost in 16",
                remedy="Set trainer.precision=bf16-mixed, or ema=null.",
            )

    def teardown(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, stage: str
    ) -> None:
        """Let go of it when the training has ended, with the average for its weights."""
        self._average_model = None

    def _move(self, averages: Any, weights: Any, _: Tensor | int) -> None:
        """Move tensors of one type towards the weights, in place."""
        if not averages[0].is_floating_point():
            for average, weight in zip(averages, weights, strict=True):
                average.copy_(weight)
            return
        steps = int(self._average_model.n_averaged)  # type: ignore[union-attr]
        decay = min(self.decay, (1 + steps) / (10 + steps))
        get_ema_multi_avg_fn(decay)(averages, weights, steps)  # type: ignore[no-untyped-call]
