"""Base class of tasks: gradient of a step, optimizer and schedule, scores of a split."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Self

import lightning
import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau
from torchmetrics import SumMetric

from tangent_train.checkpoints.outputs import network_for_views
from tangent_train.errors import at_least
from tangent_train.heads import Head
from tangent_train.heads.base import RGB
from tangent_train.heads.pictures import shown_arrays
from tangent_train.results.evaluation import evaluation_result
from tangent_train.results.evaluation_result import EvaluationResult
from tangent_train.results.html.page import EncodedImage, encode_image
from tangent_train.tasks.divergence import check_weights, refuse_loss
from tangent_train.tasks.parameter_groups import freeze, groups_of
from tangent_train.tasks.schedules import Schedule

Part = tuple[tuple[Tensor, ...], Tensor]
"""Inputs of the network, and their targets."""


class Task(lightning.LightningModule, ABC):
    """Trains a network on batches of spheres and scores it.

    All images of a step, on all processes and in all accumulated batches, contribute to one
    gradient: the loss is a sum over the step divided by a norm of the step, independent of the
    chunks in which it is computed.

    Args:
        network: Network to train.
        representation: Representation of the network's images.
        head: The meaning of the network's output: loss, scores, pictures.
        optimizer: Function that builds the optimizer from parameters; None for a task that is only
            evaluated.
        scheduler: `Schedule`, or a function that builds a learning rate scheduler from the
            optimizer, stepped every epoch; None for a constant rate.
        view_batch_size: Largest number of images per forward pass in training, which bounds
            memory; None for the whole batch. Batch normalization uses one chunk at a time; chunks
            are even.
        channels_last: True to store network and images channels last, often faster.
        compile: Arguments of `torch.compile`, empty for its defaults; None to disable it.
        frozen: Names of modules and parameters of the network that are not trained; such modules
            stay in evaluation mode.
        backbone_lr_factor: Factor of the learning rate of parameters that are not `fresh`.

    Attributes:
        monitor: Score on the validation split that selects the best epoch.
        metric: Metric of a split, see `Head.build_metric`.
        result: Value of `metric` after the last evaluation.
        evaluated: Number of images or shapes in that evaluation.
        fresh: Names of the network's tensors that were not loaded from the file of ``init_from``;
            None without such a file. Stored in checkpoints.

    Raises:
        SettingError: A setting is invalid.
    """

    result: Any
    evaluated: int

    def __init__(
        self,
        network: nn.Module,
        representation: Any,
        head: Head,
        optimizer: Callable[..., Optimizer] | None,
        scheduler: Schedule | Callable[..., LRScheduler] | None = None,
        view_batch_size: int | None = None,
        channels_last: bool = False,
        compile: Mapping[str, Any] | None = None,  # noqa: A002 - torch's own word
        frozen: Sequence[str] = (),
        backbone_lr_factor: float = 1.0,
    ) -> None:
        super().__init__()
        if view_batch_size is not None:
            at_least("task.view_batch_size", view_batch_size, 1)
        self.memory_format = torch.channels_last if channels_last else torch.contiguous_format
        network = network_for_views(network, getattr(representation, "distortion_aware", None))
        self.network: nn.Module = network.to(memory_format=self.memory_format)
        if compile is not None:
            self.network.compile(**compile)  # in place: names of tensors stay as they are
        self.representation = representation
        self.head = head
        self.make_optimizer: Any = optimizer
        is_complete = scheduler is None or isinstance(scheduler, Schedule)
        self.schedule: Any = scheduler if is_complete else Schedule(scheduler)  # type: ignore[arg-type]
        self.view_batch_size = view_batch_size
        self.backbone_lr_factor = backbone_lr_factor
        self.fresh: Collection[str] | None = None
        # A tuple: in a `ModuleList`, their tensors would have second names.
        self._frozen = tuple(freeze(self.network, frozen))
        self.monitor = f"val/{head.main_score}"
        self.metric: Any = head.build_metric()
        self._counted = SumMetric()
        # The validation loss and its norm, without the check for NaN, for which the host waits for
        # a GPU. (A `MeanMetric` without this check ignores weights.)
        self._losses: Any = nn.ModuleList(SumMetric(nan_strategy="disable") for _ in range(2))
        self._pending: tuple[Tensor, Any, Any] | None = None
        self._step_norm: Any = None

    @abstractmethod
    def example(self, channels: int) -> Tensor:
        """Return an empty input of the network, of the size of the run."""

    @abstractmethod
    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return the inputs of the network and their targets, with a common first dimension."""

    @abstractmethod
    def evaluate(self, batch: Any) -> Tensor:
        """Add the predictions for a batch to `metric` and return them."""

    def loss_sum(self, inputs: tuple[Tensor, ...], targets: Tensor) -> Tensor:
        """Return the sum of the losses of inputs."""
        return self.head.loss_sum(self(*inputs), targets)

    def true_labels(self, batch: Any) -> Tensor:
        """Return the true labels of an evaluated batch, one item per prediction."""
        labels: Tensor = batch.labels
        return labels

    # Training

    @property
    def inputs_per_sample(self) -> int:
        """Number of the network's inputs for a sample of a training step."""
        return 1

    def empty_step(self, channels: int, samples: int) -> Tensor:
        """Return empty inputs of a training step on the device ``meta``, which takes no memory.

        Args:
            channels: Number of input channels.
            samples: Number of samples in the step.
        """
        example = self.example(channels).to("meta")
        return example.expand(samples * self.inputs_per_sample, *example.shape[1:])

    def training_parts(self, batch: Any) -> list[Part]:
        """Divide a batch into parts, see `chunks`."""
        inputs, targets = self.training_pairs(batch)
        chunks = self.chunks(inputs)
        of_chunks = torch.tensor_split(targets, len(chunks))
        return [((chunk,), part) for chunk, part in zip(chunks, of_chunks, strict=True)]

    def chunks(self, inputs: Tensor) -> tuple[Tensor, ...]:
        """Divide inputs into even chunks of at most `view_batch_size` images, at least one input.

        Batch normalization fails on a single value per channel: 20 images in chunks of at most 19
        are divided into 10 and 10, not 19 and 1.
        """
        if self.view_batch_size is None:
            return (inputs,)
        size = max(1, self.view_batch_size // inputs.shape[1:-3].numel())
        return torch.tensor_split(inputs, -(-len(inputs) // size))

    def setup(self, stage: str) -> None:
        """Take settings of the loss from the data before training; a checkpoint contains them."""
        if stage == "fit" and not self.trainer.ckpt_path:
            self.head.read_data(self.trainer.datamodule)  # type: ignore[attr-defined]

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Add to the gradient of a step over all chunks, accumulated batches and processes.

        All parts but the last are back-propagated here; Lightning back-propagates the last one. On
        several processes, this method is called inside `DistributedDataParallel.forward`, which
        exchanges gradients only in a backward pass after it: once, for the last part.

        With `trainer.accumulate_grad_batches`, the gradients are those of the batches so far:
        before another batch is added, they are scaled by the ratio of the old norm to the new one.

        Lightning's manual optimization would be longer: it has no accumulation, gradient clipping
        or scheduler steps, and exchanges gradients after each part.
        """
        *parts, last = self.training_parts(batch)
        strategy = self.trainer.strategy
        # The mean over processes, because gradients are averaged too.
        norm: Any = sum(self.head.loss_norm(targets) for _, targets in (*parts, last))
        norm = strategy.reduce(norm, reduce_op="mean").clamp(min=torch.finfo(norm.dtype).tiny)
        if batch_idx % self.trainer.accumulate_grad_batches == 0:
            self.trainer.optimizers[0].zero_grad()
            self._step_norm = norm
        else:
            before, self._step_norm = self._step_norm, self._step_norm + norm
            for parameter in self.parameters():
                if parameter.grad is not None:
                    parameter.grad *= before / self._step_norm
        value = norm.new_zeros(())
        for part in parts:
            loss = self.loss_sum(*part)
            strategy.backward(loss / self._step_norm, None)
            value += loss.detach()
        loss = self.loss_sum(*last)
        total: Any = strategy.reduce((value + loss.detach()) / norm, reduce_op="mean")
        # Copied to the host while a GPU is busy with the backward pass.
        copied = torch.cuda.Event() if total.is_cuda else None  # type: ignore[no-untyped-call]
        self._pending = (total.to("cpu", non_blocking=True), copied, batch)
        if copied is not None:
            copied.record()
        # Lightning divides by the number of accumulated batches.
        return loss / self._step_norm * self.trainer.accumulate_grad_batches

    def on_after_backward(self) -> None:
        """Log the loss, and stop all processes before a step with a loss that is not finite.

        Gradients are not checked: with `trainer.precision=16-mixed`, steps whose gradients overflow
        are skipped, and the loss scale shrinks.

        Raises:
            SettingError: The loss is NaN or infinite.
        """
        if self._pending is None:  # not the last part
            return
        loss, copied, batch = self._pending
        self._pending = None
        if copied is not None:
            copied.synchronize()
        if not math.isfinite(loss):
            refuse_loss(self, float(loss), batch)
        # A value on the CPU: the progress bar reads it every step, and would wait for a GPU.
        self.log("train/loss", loss, prog_bar=True)

    def optimizer_zero_grad(self, *_: Any) -> None:
        """Do nothing: `training_step` clears the gradients before its first part."""

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation; frozen modules stay in evaluation mode."""
        super().train(mode)
        for module in self._frozen:
            module.eval()
        return self

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Store `fresh`; keep the file of earlier weights if these are not finite."""
        check_weights(self)
        if self.fresh is not None:
            checkpoint["fresh"] = sorted(self.fresh)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore `fresh`, before the optimizer is built."""
        fresh = checkpoint.get("fresh")
        self.fresh = None if fresh is None else frozenset(map(str, fresh))

    # Evaluation

    @property
    def is_tested(self) -> bool:
        """True during a test, in which no loss is computed."""
        return self._trainer is not None and self._trainer.testing

    def add_validation_loss(self, outputs: Tensor, targets: Tensor) -> None:
        """Add to ``val/loss``, which is normalized like the training loss."""
        values = self.head.loss_sum(outputs, targets), self.head.loss_norm(targets)
        for total, value in zip(self._losses, values, strict=True):
            total.update(value)

    def validation_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Evaluate a batch of the validation or test split."""
        predictions = self.evaluate(batch)
        self._counted.update(len(predictions))
        return predictions

    def on_validation_epoch_end(self) -> None:
        """Log the scores of the validation or test split."""
        stage = "test" if self.is_tested else "val"
        self.result, self.evaluated = self.metric.compute(), int(self._counted.compute())
        self.metric.reset()
        self._counted.reset()
        # A process without images takes part too.
        if not self.is_tested:
            loss, norm = (total.compute() for total in self._losses)
            self.log("val/loss", loss / norm, sync_dist=True)
            for total in self._losses:
                total.reset()
        scores = self.head.scores(self.result)
        # All processes have the same scores, which the mean over processes does not change.
        for name, score in scores.means.items():
            key = f"{stage}/{name}"
            self.log(key, score, prog_bar=key == self.monitor, sync_dist=True)
        of_class = next(filter(None, (self.head.columns[n].of_class for n in scores.means)), None)
        if of_class is not None:
            values = scores.of_classes[of_class].tolist()
            names = self.head.class_names[-len(values) :]
            for name, score in zip(names, values, strict=True):
                if not math.isnan(score):
                    self.log(f"{stage}_{of_class}/{name}", score, sync_dist=True)

    test_step = validation_step
    on_test_epoch_end = on_validation_epoch_end

    def evaluation_result(self, noun: str) -> EvaluationResult:
        """Return the last evaluation.

        Args:
            noun: Plural name of the images: panoramas, photos, shapes.
        """
        return evaluation_result(self.head, self.result, noun, self.evaluated)

    def picture(
        self, image: Any, target: Tensor, prediction: Tensor, most_rows: int | None = None
    ) -> RGB | None:
        """Draw one prediction, for `panels` and loggers; None if the head draws no pictures.

        Args:
            image: `Panorama` or `Photo`.
            target: True labels of the image, one item of `true_labels`.
            prediction: Prediction for the image, one item of the result of `evaluate`.
            most_rows: Largest number of rows of the image in the picture; None for all.
        """
        if not target.ndim:
            return None
        truth = self.head.truth(target)
        shown = shown_arrays(image, truth, prediction, self.representation, most_rows)
        return self.head.panel(*shown)

    def report_image(
        self, name: str, image: Any, target: Tensor, prediction: Tensor
    ) -> EncodedImage:
        """Return an image with its true and predicted pixels for the report's viewer.

        Args:
            name: Name of the image.
            image: See `picture`.
            target: See `picture`.
            prediction: See `picture`.
        """
        truth, note = self.head.truth(target), self.head.note(prediction, self.head.truth(target))
        rgb, true, shown = shown_arrays(image, truth, prediction, self.representation, cut=False)
        count, sphere = len(self.head.class_names), target.ndim == 2
        return encode_image(
            name, rgb, count, prediction=shown, truth=true, sphere=sphere, note=note
        )

    # Optimizer and schedule

    def configure_optimizers(self) -> Any:
        """Build the optimizer, and the scheduler if there is one."""
        factor = self.backbone_lr_factor
        trained = {n: p for n, p in self.network.named_parameters() if p.requires_grad}
        if factor == 1:
            groups: Any = [{"params": list(trained.values())}]
        else:
            groups = groups_of(trained, self.fresh or ())
        optimizer = self.make_optimizer(groups)
        factors = [factor if group.get("name") == "backbone" else 1 for group in groups]
        for group, group_factor in zip(optimizer.param_groups, factors, strict=True):
            group["lr"] *= group_factor
        if self.schedule is None:
            return optimizer
        built = self.schedule.configure(optimizer, self.trainer, factors, self.monitor, self.head)
        return {"optimizer": optimizer, "lr_scheduler": built}

    def on_train_epoch_end(self) -> None:
        """Step `ReduceLROnPlateau` before the checkpoint of the epoch is saved.

        Lightning would step it afterwards, so that the checkpoint would not contain the step.
        """
        for config in self.trainer.lr_scheduler_configs:
            is_due = (self.current_epoch + 1) % config.frequency == 0
            if is_due and isinstance(config.scheduler, ReduceLROnPlateau):
                config.scheduler.step(self.trainer.callback_metrics[str(config.monitor)])

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """Step schedulers as Lightning does, except for `ReduceLROnPlateau`."""
        if not isinstance(scheduler, ReduceLROnPlateau):
            super().lr_scheduler_step(scheduler, metric)
