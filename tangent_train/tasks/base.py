"""What all tasks share: one gradient of a batch, the optimizer, and what a run asks of them."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import lightning
import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from datamodules.core.split_module import Kind
from tangent_train.errors import SettingError
from tangent_train.tasks.divergence import LossWatch, check_weights, stop

__all__ = ["Part", "Task", "check_at_once"]

Part = tuple[tuple[Tensor, ...], Tensor]
"""Inputs of the network and their labels."""


class Task(lightning.LightningModule, ABC):
    """Trains a network on batches of spheres and says what runs need to know about it.

    All images of a batch, on all processes, make one gradient: the loss is a sum over the batch
    divided by a norm of the batch, whatever the chunks it is computed in.

    Args:
        network: What is trained.
        representation: What made its images.
        class_names: Names of the classes.
        optimizer: Makes the optimizer from parameters.
        scheduler: Makes a learning rate scheduler from the optimizer, or None. When it takes
            `total_steps`, it is told the length of the training and stepped every step.
        label_smoothing: Share of the target spread over all classes.
        images_per_chunk: Images trained at once, a bound on memory; None for the whole batch.
        channels_last: Memory format of the network, often faster.
        compile: Arguments of `torch.compile` for the network, empty for its defaults; None not to.

    Attributes:
        kind: What is learned; data modules say what they are labelled for.
        monitor: The figure of the validation split that makes an epoch the best one.
        takes: What a network for this task maps to what, for messages.

    Raises:
        SettingError: A setting that cannot work.
    """

    kind: ClassVar[Kind]
    monitor: ClassVar[str]
    takes: ClassVar[str]

    def __init__(
        self,
        network: nn.Module,
        representation: Any,
        class_names: Sequence[str],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None = None,
        *,
        label_smoothing: float = 0.0,
        images_per_chunk: int | None = None,
        channels_last: bool = False,
        compile: Mapping[str, Any] | None = None,  # noqa: A002 - torch's own word
    ) -> None:
        super().__init__()
        if not 0 <= label_smoothing < 1:
            raise SettingError("task.label_smoothing", found=label_smoothing, expected="0 to 1")
        check_at_once("images_per_chunk", images_per_chunk)
        self.memory_format = torch.channels_last if channels_last else torch.contiguous_format
        self.network: nn.Module = network.to(memory_format=self.memory_format)
        if compile is not None:
            self.network.compile(**compile)  # in place: names of tensors stay as they are
        self.representation = representation
        self.class_names = tuple(class_names)
        self.make_optimizer = optimizer
        self.make_scheduler = scheduler
        self.label_smoothing = label_smoothing
        self.images_per_chunk = images_per_chunk
        self._loss_watch = LossWatch()

    @abstractmethod
    def example(self, channels: int) -> Tensor:
        """An empty input of the network, of the size of the run."""

    @abstractmethod
    def training_labels(self, batch: Any) -> Tensor:
        """The labels of all inputs of a batch."""

    @abstractmethod
    def training_parts(self, batch: Any) -> list[Part]:
        """A batch in parts that are trained one after the other, a bound on memory."""

    @abstractmethod
    def loss_sum(self, inputs: tuple[Tensor, ...], labels: Tensor) -> Tensor:
        """The loss of one part, a sum.

        Args:
            inputs: Of the network.
            labels: Of the inputs.
        """

    @abstractmethod
    def loss_norm(self, labels: Tensor) -> Tensor:
        """What the loss of all is divided by: known before any network has run.

        Args:
            labels: Of all inputs.
        """

    @abstractmethod
    def evaluate(self, batch: Any) -> Tensor:
        """Count what the network makes of a batch; returns the predictions for the callbacks."""

    @abstractmethod
    def log_scores(self, stage: str) -> None:
        """Log the scores of all that was counted, keep them for the results, and start anew.

        Args:
            stage: ``val`` or ``test``.
        """

    def on_train_start(self) -> None:
        """Refuse to resume a schedule that was made for another length of training.

        Raises:
            SettingError: The length has changed.
        """
        steps = int(self.trainer.estimated_stepping_batches)
        for config in self.trainer.lr_scheduler_configs:
            planned = getattr(config.scheduler, "total_steps", steps)
            if planned != steps:
                raise SettingError(
                    "trainer.max_epochs, trainer.devices and data.…_per_step",
                    found=f"{steps} steps of training",
                    expected=f"{planned}, which the schedule of the resumed run was made for",
                    remedy="Resume with the same, or start a new run.",
                )

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """One gradient of the whole batch, over all chunks and processes.

        All parts but the last are back-propagated here, Lightning does the last one. On several
        processes this is still inside `DistributedDataParallel.forward`, which exchanges gradients
        only in a backward pass that follows it: once, after the last part.
        """
        norm = self._whole_norm(self.training_labels(batch))
        batches = self.trainer.accumulate_grad_batches
        if batch_idx % batches == 0:
            self.trainer.optimizers[0].zero_grad()
        *parts, last = self.training_parts(batch)
        value = norm.new_zeros(())
        for part in parts:
            loss = self._loss(part, norm)
            self.trainer.strategy.backward(loss / batches, None)
            value += loss.detach()
        loss = self._loss(last, norm)
        # The mean over processes, each divided by the mean norm, is the loss of the whole batch.
        whole: Any = self.trainer.strategy.reduce(value + loss.detach(), reduce_op="mean")
        self.log("train/loss", whole, prog_bar=True)
        self._loss_watch.begin(whole, batch)
        return loss

    def on_after_backward(self) -> None:
        """Stop before a step whose loss is no number, on all processes.

        What gradients do when `trainer.precision=16-mixed` scales them too far is not looked at:
        such steps are left out and the scale shrinks, as it should.

        Raises:
            SettingError: It is none.
        """
        found = self._loss_watch.end()  # None after all parts but the last
        if found is not None and not math.isfinite(found[0]):
            stop(self, *found)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """See `check_weights`."""
        check_weights(self)

    def optimizer_zero_grad(self, *_: Any) -> None:
        """Nothing: `training_step` clears the gradients before its first part."""

    def _whole_norm(self, labels: Tensor) -> Tensor:
        """The norm of the loss over all processes; as their gradients are averaged, the mean."""
        norm = self.loss_norm(labels)
        mean: Tensor = self.trainer.strategy.reduce(norm, reduce_op="mean")
        return mean.clamp(min=torch.finfo(norm.dtype).tiny)

    def _loss(self, part: Part, norm: Tensor) -> Tensor:
        return self.loss_sum(*part) / norm

    def validation_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Count a batch of the validation split."""
        return self.evaluate(batch)

    def test_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Count a batch of the test split."""
        return self.evaluate(batch)

    def on_validation_epoch_end(self) -> None:
        """Log the scores of the validation split."""
        self.log_scores("val")

    def on_test_epoch_end(self) -> None:
        """Log the scores of the test split."""
        self.log_scores("test")

    def configure_optimizers(self) -> Any:
        """Optimizer, and scheduler if there is one."""
        return self.optimization(lambda: int(self.trainer.estimated_stepping_batches))

    def optimization(self, count_steps: Callable[[], int]) -> Any:
        """The same for any number of steps.

        Args:
            count_steps: Of the whole training; asked for where the scheduler wants to know.
        """
        optimizer = self.make_optimizer(self.parameters())
        if self.make_scheduler is None:
            return optimizer
        by_step = "total_steps" in inspect.signature(self.make_scheduler).parameters
        length = {"total_steps": count_steps()} if by_step else {}
        scheduler = self.make_scheduler(optimizer, **length)
        interval = "step" if by_step else "epoch"
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": scheduler, "interval": interval},
        }


def check_at_once(name: str, count: object) -> None:
    """Refuse a bound on memory that lets nothing through.

    Args:
        name: Of the setting, below ``task``.
        count: Images at once; None for no bound.

    Raises:
        SettingError: It is neither a whole number from 1 nor None.
    """
    if count is not None and (not isinstance(count, int) or count < 1):
        raise SettingError(f"task.{name}", found=count, expected="a whole number from 1")
