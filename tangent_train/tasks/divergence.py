"""A training whose loss is no number any more: it stops before the network is changed by it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

import lightning
import torch
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.files import NoRoomError, atomic_path

__all__ = ["BATCH_FILE", "LossWatch", "check_weights", "stop"]

BATCH_FILE = "stopped_batch.pt"
"""In the run's folder: the batch whose loss was no number, see `stop`."""

_NAMED = 5


class LossWatch:
    """Reads the loss of every step without keeping a GPU waiting.

    The copy to the CPU is begun when the forward pass has been queued and read when the backward
    pass has been: the GPU computes that meanwhile.
    """

    def __init__(self) -> None:
        self._copy: Tensor | None = None
        self._copied: Any = None
        self._batch: Any = None

    def begin(self, loss: Tensor, batch: Any) -> None:
        """Take the loss of a batch."""
        self._batch = batch
        self._copy = loss.to("cpu", non_blocking=True)  # into memory that takes copies by itself
        if loss.is_cuda:
            self._copied = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._copied.record()

    def end(self) -> tuple[float, Any] | None:
        """The loss and its batch, once; None in between."""
        if self._copy is None:
            return None
        if self._copied is not None:
            self._copied.synchronize()
        loss, batch = float(self._copy), self._batch
        self._copy = self._copied = self._batch = None  # no batch is kept while the next one comes
        return loss, batch


def stop(task: lightning.LightningModule, loss: float, batch: Any) -> NoReturn:
    """Keep the batch for inspection and end the training.

    The file holds the tensors of the batch by name, as the network got them, ``names`` of its
    images, ``step``, ``epoch`` and ``loss``, and loads with ``weights_only=True``. Each process
    keeps its own.

    Args:
        task: What is trained; its weights are those before the step.
        loss: Of all processes.
        batch: A named tuple.

    Raises:
        SettingError: Always.
    """
    trainer = task.trainer
    rank = "" if trainer.world_size == 1 else f"_{trainer.global_rank}"
    path = Path(trainer.default_root_dir) / f"{Path(BATCH_FILE).stem}{rank}.pt"
    content: dict[str, Any] = {
        name: value.detach().cpu() for name, value in batch._asdict().items() if _is_tensor(value)
    }
    content |= {"names": _names(trainer, batch), "loss": loss}
    content |= {"step": trainer.global_step, "epoch": trainer.current_epoch}
    kept = f"The batch is in {path}, to look at with torch.load."
    try:
        with atomic_path(path) as temporary:
            torch.save(content, temporary)
    except NoRoomError as error:
        kept = f"The batch could not be kept: {error}"
    raise SettingError(
        f"loss of step {trainer.global_step} (epoch {trainer.current_epoch}, "
        f"{_some(content['names'])})",
        found=f"{loss}{_reason(task, content)}",
        expected="a number",
        remedy=f"{_remedy(trainer)} {kept}",
    )


def check_weights(task: lightning.LightningModule) -> None:
    """Refuse to write a checkpoint that nobody could use over one that is good.

    Args:
        task: What is trained.

    Raises:
        SettingError: A weight, or a statistic of batch normalization, is no number.
    """
    broken = _not_finite(task)
    if broken:
        trainer = task.trainer
        raise SettingError(
            f"weights after step {trainer.global_step} (epoch {trainer.current_epoch})",
            found=f"values that are no numbers in {_some(broken)}",
            expected="numbers: the checkpoints before are left as they are",
            remedy=_remedy(trainer),
        )


def _is_tensor(value: object) -> bool:
    return isinstance(value, Tensor)


def _names(trainer: lightning.Trainer, batch: Any) -> list[str]:
    """Names of what is in the batch, or their places in the training split."""
    places: Any = getattr(batch, "index", ())
    indices = places.tolist() if isinstance(places, Tensor) else []  # a tuple has a method of it
    name: Any = getattr(trainer.datamodule, "sample_name", None)  # type: ignore[attr-defined]
    return [str(index) if name is None else name("train", index) for index in indices]


def _some(names: Iterable[str]) -> str:
    listed = list(names)
    more = len(listed) - _NAMED
    return ", ".join(listed[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _reason(task: lightning.LightningModule, batch: dict[str, Any]) -> str:
    images = batch.get("images")
    if images is not None and not images.isfinite().all():
        return ", of images that hold values that are no numbers"
    broken = _not_finite(task)
    if broken:
        return f", of a network with values that are no numbers already, in {_some(broken)}"
    return ", of images and weights that are numbers"


def _not_finite(task: lightning.LightningModule) -> list[str]:
    """Names of tensors that no training survives; a mask of a network may well hold infinities."""
    found = {name: tensor.isfinite().all() for name, tensor in task.named_parameters()}
    found |= {name: ~tensor.isnan().any() for name, tensor in task.named_buffers()}
    if torch.stack(list(found.values())).all():  # waits for a GPU once
        return []
    return [name for name, fine in found.items() if not fine]


def _remedy(trainer: lightning.Trainer) -> str:
    tries = ["a smaller optimizer.lr", "trainer.gradient_clip_val=1"]
    if str(trainer.precision).startswith("16"):
        tries.insert(0, "trainer.precision=bf16-mixed (16 bits overflow beyond 65504)")
    return f"Try, in a new run, {', '.join(tries[:-1])} or {tries[-1]}."
