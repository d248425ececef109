"""Stop a diverged training before its weights or its checkpoints are changed."""

from __future__ import annotations

import math
from typing import Any

import lightning
from torch import Tensor

from tangent_train.errors import SettingError

_NAMED = 5
"""Images and tensors that a message names, at most."""


def check_loss(task: lightning.LightningModule, loss: float, batch: Any) -> None:
    """Stop training at a loss that is not finite, and name its cause.

    Args:
        task: Task with the weights before the step.
        loss: Loss over all processes.
        batch: Batch of this process.

    Raises:
        SettingError: The loss is NaN or infinite.
    """
    if math.isfinite(loss):
        return
    cause = "finite images and weights"
    if not batch.images.isfinite().all():
        cause = "images with NaN or infinite values"
    elif broken := _broken_tensors(task):
        cause = f"weights that were not finite before: {broken}"
    data: Any = task.trainer.datamodule  # type: ignore[attr-defined]
    names = [data.dataset("train").name(index) for index in batch.index.tolist()]
    _stop(task, "loss of", f"{loss}, from {cause}", *names)


def check_weights(task: lightning.LightningModule) -> None:
    """Refuse to save weights that are not finite: a finite loss may have an infinite gradient.

    Raises:
        SettingError: A weight is NaN or infinite.
    """
    if broken := _broken_tensors(task):
        _stop(task, "weights after", f"NaN or infinite values in {broken}")


def _broken_tensors(task: lightning.LightningModule) -> str:
    """Return names of tensors with NaN or infinite weights; buffers may hold infinities."""

    def is_broken(tensor: Tensor) -> bool:
        return not (tensor.isfinite() if tensor.requires_grad else ~tensor.isnan()).all()

    tensors = (*task.named_parameters(), *task.named_buffers())
    return ", ".join([name for name, tensor in tensors if is_broken(tensor)][:_NAMED])


def _stop(task: lightning.LightningModule, subject: str, found: str, *names: str) -> None:
    trainer = task.trainer
    place = ", ".join([f"epoch {trainer.current_epoch}", *names[:_NAMED]])
    remedy = "Try, in a new run, a smaller optimizer.lr or trainer.gradient_clip_val=1."
    if str(trainer.precision).startswith("16"):
        remedy += " Or trainer.precision=bf16-mixed: float16 overflows beyond 65504."
    subject = f"{subject} step {trainer.global_step} ({place})"
    raise SettingError(subject, found=found, expected="finite numbers", remedy=remedy)
