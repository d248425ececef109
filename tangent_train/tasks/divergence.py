"""Stop a diverged training before its weights or its checkpoints are changed."""

from __future__ import annotations

from typing import Any, NoReturn

import lightning
from torch import Tensor

from tangent_train.errors import SettingError

_NAMED = 5
_REMEDY = "a smaller optimizer.lr or trainer.gradient_clip_val=1."


def refuse_loss(task: lightning.LightningModule, loss: float, batch: Any) -> NoReturn:
    """Stop training at a non-finite loss and name its cause.

    Args:
        task: Task with the weights before the step.
        loss: Loss over all processes.
        batch: Batch of this process.

    Raises:
        SettingError: Always.
    """
    reason = "from finite images and weights"
    if not batch.images.isfinite().all():
        reason = "from images with NaN or infinite values"
    elif broken := _not_finite(task):
        reason = f"from weights that were not finite before: {_some(broken)}"
    trainer: Any = task.trainer
    names = [trainer.datamodule.dataset("train").name(k) for k in batch.index.tolist()]
    half = str(trainer.precision).startswith("16")
    precision = "trainer.precision=bf16-mixed (float16 overflows beyond 65504), " if half else ""
    raise SettingError(
        f"loss of step {trainer.global_step} (epoch {trainer.current_epoch}, {_some(names)})",
        found=f"{loss}, {reason}",
        expected="a finite number",
        remedy=f"Try, in a new run, {precision}{_REMEDY}",
    )


def check_weights(task: lightning.LightningModule) -> None:
    """Refuse to save weights that are not finite: a finite loss may have an infinite gradient.

    Raises:
        SettingError: A weight is NaN or infinite.
    """
    if broken := _not_finite(task):
        raise SettingError(
            f"weights after step {task.trainer.global_step} (epoch {task.trainer.current_epoch})",
            found=f"NaN or infinite values in {_some(broken)}",
            expected="finite numbers; the last checkpoint has them",
            remedy=f"Try, in a new run, {_REMEDY}",
        )


def _not_finite(task: lightning.LightningModule) -> list[str]:
    """Return the names of tensors with NaN or infinite weights; buffers may hold infinities."""

    def is_broken(tensor: Tensor) -> bool:
        return not (tensor.isfinite() if tensor.requires_grad else ~tensor.isnan()).all()

    tensors = (*task.named_parameters(), *task.named_buffers())
    return [name for name, tensor in tensors if is_broken(tensor)]


def _some(names: list[str]) -> str:
    """Return the first names of a list, and the number of the others."""
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
