"""Stop a diverged training before its weights or its checkpoints are changed."""

from __future__ import annotations

import math
from typing import Any

import lightning

from tangent_train.errors import SettingError

_NAMED = 5
"""Images that a message names, at most."""


def check_loss(task: lightning.LightningModule, loss: float, batch: Any) -> None:
    """Stop training at a loss that is not finite, and name the images.

    Args:
        task: Task with the weights before the step.
        loss: Loss over all processes.
        batch: Batch of this process.

    Raises:
        SettingError: The loss is NaN or infinite.
    """
    if not math.isfinite(loss):
        data: Any = task.trainer.datamodule  # type: ignore[attr-defined]
        names = [data.dataset("train").name(index) for index in batch.index.tolist()]
        _stop(task, "loss of", str(loss), *names)


def check_weights(task: lightning.LightningModule) -> None:
    """Refuse to save weights that are not finite: a finite loss may have an infinite gradient.

    Raises:
        SettingError: A weight is NaN or infinite.
    """
    for name, tensor in (*task.named_parameters(), *task.named_buffers()):
        # Buffers may hold infinities.
        if not (tensor.isfinite() if tensor.requires_grad else ~tensor.isnan()).all():
            _stop(task, "weights after", f"NaN or infinite values in {name}")


def _stop(task: lightning.LightningModule, subject: str, found: str, *names: str) -> None:
    trainer = task.trainer
    place = ", ".join([f"epoch {trainer.current_epoch}", *names[:_NAMED]])
    remedy = "Try, in a new run, a smaller optimizer.lr or trainer.gradient_clip_val=1."
    if str(trainer.precision).startswith("16"):
        remedy += " Or trainer.precision=bf16-mixed: float16 overflows beyond 65504."
    subject = f"{subject} step {trainer.global_step} ({place})"
    raise SettingError(subject, found=found, expected="finite numbers", remedy=remedy)
