"""Base class of tasks: gradient of a step, optimizer and schedule, scores of a split."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self

import lightning
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau
from torchmetrics import Metric, SumMetric

from datamodules.core.labels import PIXEL_CLASSES
from tangent_train.checkpoints.kinds import DepthKind
from tangent_train.checkpoints.scores import network_for_views
from tangent_train.errors import SettingError, at_least
from tangent_train.metrics.score_columns import ScoreColumn
from tangent_train.results.evaluation_result import EvaluationResult, plain_scores
from tangent_train.results.html.page import EncodedImage, encode_image
from tangent_train.tasks.divergence import check_weights, refuse_loss
from tangent_train.tasks.parameter_groups import freeze, groups_of
from tangent_train.tasks.schedules import Schedule

Part = tuple[tuple[Tensor, ...], Tensor]
"""Inputs of the network, and their labels."""

RGB = NDArray[np.uint8]
"""A picture ``(H, W, 3)``."""


class Task(lightning.LightningModule, ABC):
    """Trains a network on batches of spheres and scores it.

    All images of a step, on all processes and in all accumulated batches, contribute to one
    gradient: the loss is a sum over the step divided by a norm of the step, independent of the
    chunks in which it is computed.

    Args:
        network: Network to train.
        representation: Representation of the network's images.
        class_names: Names of the classes.
        optimizer: Function that builds the optimizer from parameters; None for a task that is only
            evaluated.
        scheduler: `Schedule`, or a function that builds a learning rate scheduler from the
            optimizer, stepped every epoch; None for a constant rate.
        label_smoothing: Fraction of the target that is spread over all classes.
        view_batch_size: Largest number of images per forward pass in training, which bounds
            memory; None for the whole batch. Batch normalization uses one chunk at a time; chunks
            are even.
        channels_last: True to store network and images channels last, often faster.
        compile: Arguments of `torch.compile`, empty for its defaults; None to disable it.
        frozen: Names of modules and parameters of the network that are not trained; such modules
            stay in evaluation mode.
        backbone_lr_factor: Factor of the learning rate of parameters that are not `fresh`.

    Attributes:
        labels: Kind of labels that a data set must have, see `datamodules.core.labels`.
        predicts: Kind of predictions, e.g. `PIXEL_CLASSES`, for commands that read a checkpoint.
        monitor: Score on the validation split that selects the best epoch.
        depth_kind: Kind of the network's output, if it predicts distances; else None.
        takes: Input and output of a network for this task, for messages.
        columns: Names and units of the scores over a split, in the order of the tables.
        metric: Metric of a split, see `build_metric`.
        result: Value of `metric` after the last evaluation.
        evaluated: Number of images or shapes in that evaluation.
        fresh: Names of the network's tensors that were not loaded from the file of ``init_from``;
            None without such a file. Stored in checkpoints.

    Raises:
        SettingError: A setting is invalid.
    """

    labels: ClassVar[str] = PIXEL_CLASSES
    predicts: ClassVar[str] = ""
    monitor: ClassVar[str]
    takes: ClassVar[str]
    columns: ClassVar[Mapping[str, ScoreColumn]]
    depth_kind: DepthKind | None = None
    result: Any
    evaluated: int

    def __init__(
        self,
        network: nn.Module,
        representation: Any,
        class_names: Sequence[str],
        optimizer: Callable[..., Optimizer] | None,
        scheduler: Schedule | Callable[..., LRScheduler] | None = None,
        label_smoothing: float = 0.0,
        view_batch_size: int | None = None,
        channels_last: bool = False,
        compile: Mapping[str, Any] | None = None,  # noqa: A002 - torch's own word
        frozen: Sequence[str] = (),
        backbone_lr_factor: float = 1.0,
    ) -> None:
        super().__init__()
        if not 0 <= label_smoothing < 1:
            raise SettingError("task.label_smoothing", found=label_smoothing, expected="0 to 1")
        if view_batch_size is not None:
            at_least("task.view_batch_size", view_batch_size, 1)
        if not (isinstance(backbone_lr_factor, int | float) and 0 < backbone_lr_factor < math.inf):
            raise SettingError(
                "task.backbone_lr_factor",
                found=backbone_lr_factor,
                expected="a number greater than 0",
                remedy="To train parts not at all, use task.frozen=[…].",
            )
        self.memory_format = torch.channels_last if channels_last else torch.contiguous_format
        network = network_for_views(network, getattr(representation, "distortion_aware", None))
        self.network: nn.Module = network.to(memory_format=self.memory_format)
        if compile is not None:
            self.network.compile(**compile)  # in place: names of tensors stay as they are
        self.representation = representation
        self.class_names = tuple(class_names)
        self.make_optimizer: Any = optimizer
        is_complete = scheduler is None or isinstance(scheduler, Schedule)
        self.schedule: Any = scheduler if is_complete else Schedule(scheduler)  # type: ignore[arg-type]
        self.label_smoothing = label_smoothing
        self.view_batch_size = view_batch_size
        self.backbone_lr_factor = backbone_lr_factor
        self.fresh: Collection[str] | None = None
        # A tuple: in a `ModuleList`, their tensors would have second names.
        self._frozen = tuple(freeze(self.network, frozen))
        self.metric: Any = self.build_metric()
        self._counted = SumMetric()
        # The validation loss and its norm, without the check for NaN, for which the host waits for
        # a GPU. (A `MeanMetric` without this check ignores weights.)
        self._losses: Any = nn.ModuleList(SumMetric(nan_strategy="disable") for _ in range(2))
        self._pending: tuple[Tensor, Any, Any] | None = None
        self._step_norm: Any = None
        self._trained_length: Mapping[str, int] | None = None

    @staticmethod
    def num_outputs(num_classes: int) -> int:
        """Return the number of outputs of a network whose ``num_classes`` is null.

        By default, there is one output for each class.

        Args:
            num_classes: Number of classes of the data.
        """
        return num_classes

    @classmethod
    def mode_of(cls, monitor: str) -> Literal["max", "min"]:
        """Return ``min`` for a loss and for errors, see `ScoreColumn.better`; else ``max``.

        Args:
            monitor: Name of a logged value, e.g. ``val/miou``.
        """
        heading = cls.columns.get(monitor.partition("/")[2])
        is_error = heading is not None and heading.better == "lower"
        return "min" if is_error or monitor.endswith("loss") else "max"

    @abstractmethod
    def example(self, channels: int) -> Tensor:
        """Return an empty input of the network, of the size of the run."""

    @abstractmethod
    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return the inputs of the network and their labels, with a common first dimension."""

    @abstractmethod
    def loss_sum(self, inputs: tuple[Tensor, ...], labels: Tensor) -> Tensor:
        """Return the sum of the losses of inputs."""

    @abstractmethod
    def loss_norm(self, labels: Tensor) -> Tensor:
        """Return the number that the sum of the losses is divided by."""

    @abstractmethod
    def evaluate(self, batch: Any) -> Tensor:
        """Add the predictions for a batch to `metric` and return them."""

    @abstractmethod
    def build_metric(self) -> Metric:
        """Build the metric of a split, whose state is summed over all processes."""

    @abstractmethod
    def logged_scores(self, result: Any) -> dict[str, float]:
        """Return scores over the whole split by name, the main score first.

        A score ``miou`` is logged as ``val/miou`` and ``test/miou``.

        Args:
            result: Value of `metric`.
        """

    def class_scores(self, result: Any) -> dict[str, float]:
        """Return scores of classes by name, e.g. ``iou/wall``; NaN for absent classes.

        Args:
            result: Value of `metric`.
        """
        return {}

    def evaluation_result(self, result: Any, noun: str) -> EvaluationResult:
        """Return the last evaluation: `logged_scores` under their `columns`.

        Args:
            result: Value of `metric`.
            noun: Plural name of the images: panoramas, photos, shapes.
        """
        scores = plain_scores(self.logged_scores(result))
        means = scores | {name: None for name in self.columns if name not in scores}
        return EvaluationResult(noun, self.evaluated, self.columns, means)

    @property
    def facts(self) -> dict[str, str]:
        """Facts that the scores depend on besides those of the data, see `LabeledData.facts`."""
        return {}

    def scores_of(self, result: Any, places: Sequence[int]) -> dict[str, float]:
        """Return scores over some of the evaluated images by name; by default, none.

        Args:
            result: Value of `metric`.
            places: Places of the images in the order of the evaluation.
        """
        return {}

    def targets(self, batch: Any) -> Tensor:
        """Return the true labels of an evaluated batch, one item per prediction."""
        targets: Tensor = batch.target
        return targets

    def picture(
        self, image: Any, target: Tensor, prediction: Tensor, most_rows: int | None = None
    ) -> RGB | None:
        """Draw one prediction, for `panels` and loggers; None if the task draws no pictures.

        Args:
            image: `Panorama` or `Photo`.
            target: True labels of the image, one item of `targets`.
            prediction: Prediction for the image, one item of the result of `evaluate`.
            most_rows: Largest number of rows of the image in the picture; None for all.

        Returns:
            uint8 RGB ``(H, W, 3)``.
        """
        return None

    def report_image(
        self, name: str, image: Any, target: Tensor, prediction: Tensor
    ) -> EncodedImage | None:
        """Return an image for the report's viewer, by default the picture of the prediction.

        Args:
            name: Name of the image.
            image: See `picture`.
            target: See `picture`.
            prediction: See `picture`.
        """
        picture = self.picture(image, target, prediction)
        return None if picture is None else encode_image(name, picture, 0, sphere=False)

    def empty_step(self, channels: int, samples: int) -> Tensor:
        """Return empty inputs of a training step on the device ``meta``, which takes no memory.

        Args:
            channels: Number of input channels.
            samples: Number of samples in the step.
        """
        example = self.example(channels).to("meta")
        return example.expand(samples * self.inputs_per_sample, *example.shape[1:])

    @property
    def inputs_per_sample(self) -> int:
        """Number of the network's inputs for a sample of a training step."""
        return 1

    def training_parts(self, batch: Any) -> list[Part]:
        """Divide a batch into parts, see `chunks`."""
        inputs, labels = self.training_pairs(batch)
        chunks = self.chunks(inputs)
        chunk_labels = torch.tensor_split(labels, len(chunks))
        return [((chunk,), labels) for chunk, labels in zip(chunks, chunk_labels, strict=True)]

    def chunks(self, inputs: Tensor) -> tuple[Tensor, ...]:
        """Divide inputs into even chunks of at most `view_batch_size` images, at least one input.

        Batch normalization fails on a single value per channel: 20 images in chunks of at most 19
        are divided into 10 and 10, not 19 and 1.
        """
        if self.view_batch_size is None:
            return (inputs,)
        size = max(1, self.view_batch_size // inputs.shape[1:-3].numel())
        return torch.tensor_split(inputs, -(-len(inputs) // size))

    def on_train_start(self) -> None:
        """Refuse to resume a schedule that was made for another length of training.

        Raises:
            SettingError: The length has changed.
        """
        before, now, schedule = self._trained_length, self._length(), self.schedule
        if before is None or schedule is None:
            return
        unit = schedule.interval
        if before[unit] == now[unit]:
            return
        if schedule.has_length_of_training or schedule.ends_at(before[unit], self.make_optimizer):
            others = ", trainer.devices and data.…_per_step" * (unit == "step")
            raise SettingError(
                f"trainer.max_epochs, trainer.max_steps{others}",
                found=f"{now[unit]} training {unit}s",
                expected=f"{before[unit]}, which the schedule of the resumed run was made for",
                remedy="Resume with the same values. To train for longer, start a new run, with a "
                "new schedule, from the weights: init_from=<run>/checkpoints/last.ckpt",
            )

    def training_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Add to the gradient of a step over all chunks, accumulated batches and processes.

        All parts but the last are back-propagated here; Lightning back-propagates the last one. On
        several processes, this method is called inside `DistributedDataParallel.forward`, which
        exchanges gradients only in a backward pass after it: once, for the last part.

        With `trainer.accumulate_grad_batches`, the gradients are those of the batches so far:
        before another batch is added, they are scaled by the ratio of the old norm to the new one.
        """
        *parts, last = self.training_parts(batch)
        strategy = self.trainer.strategy
        # The mean over processes, because gradients are averaged too.
        norm: Any = sum(self.loss_norm(labels) for _, labels in (*parts, last))
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

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation; frozen modules stay in evaluation mode."""
        super().train(mode)
        for module in self._frozen:
            module.eval()
        return self

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Check the weights, see `check_weights`; store `fresh` and the length of the training."""
        check_weights(self)
        checkpoint["length"] = self._length()
        if self.fresh is not None:
            checkpoint["fresh"] = sorted(self.fresh)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore `fresh`, before the optimizer is built, and the length of the training."""
        length = checkpoint["length"]
        self._trained_length = {unit: int(length[unit]) for unit in ("step", "epoch")}
        fresh = checkpoint.get("fresh")
        self.fresh = None if fresh is None else frozenset(map(str, fresh))

    def optimizer_zero_grad(self, *_: Any) -> None:
        """Do nothing: `training_step` clears the gradients before its first part."""

    @property
    def is_tested(self) -> bool:
        """True during a test, in which no loss is computed."""
        return self._trainer is not None and self._trainer.testing

    def add_validation_loss(self, loss: Tensor, labels: Tensor) -> None:
        """Add to ``val/loss``, which is normalized like the training loss.

        Args:
            loss: Sum of losses.
            labels: Labels that the losses were computed from, see `loss_norm`.
        """
        for total, value in zip(self._losses, (loss, self.loss_norm(labels)), strict=True):
            total.update(value)

    def validation_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Evaluate a batch of the validation or test split."""
        predictions = self.evaluate(batch)
        self._counted.update(len(predictions))
        return predictions

    def on_validation_epoch_end(self) -> None:
        """Log the scores of the validation or test split.

        Raises:
            SettingError: A score has no heading, or a monitored value is not logged.
        """
        stage = "test" if self.is_tested else "val"
        self.result, self.evaluated = self.metric.compute(), int(self._counted.compute())
        self.metric.reset()
        self._counted.reset()
        # A process without images takes part too; a task without a loss logs none.
        if not self.is_tested and (self._losses[0].update_called or self.trainer.world_size > 1):
            loss, norm = (total.compute() for total in self._losses)
            self.log("val/loss", loss / norm, sync_dist=True)
            for total in self._losses:
                total.reset()
        scores = self.logged_scores(self.result)
        if scores.keys() - self.columns.keys():
            name = f"columns of {type(self).__name__}"
            raise SettingError(name, found=[*self.columns], expected=f"those of {[*scores]}")
        # All processes have the same scores, which the mean over processes does not change.
        for name, score in scores.items():
            key = f"{stage}/{name}"
            self.log(key, score, prog_bar=key == self.monitor, sync_dist=True)
        of_classes = self.class_scores(self.result)
        for name, score in of_classes.items():
            if not math.isnan(score):
                self.log(f"{stage}_{name}", score, sync_dist=True)
        if not self.is_tested:
            self._check_monitors(
                {*self.trainer.callback_metrics, *(f"val_{n}" for n in of_classes)}
            )

    def _check_monitors(self, logged: Collection[str]) -> None:
        """Refuse monitored validation values that are not logged, before a callback reads them."""
        monitors = [
            (f"monitor of {type(callback).__name__}", getattr(callback, "monitor", None))
            for callback in self.trainer.callbacks  # type: ignore[attr-defined]
            if getattr(callback, "strict", True)
        ]
        monitors += [
            ("scheduler.monitor", config.monitor)
            for config in self.trainer.lr_scheduler_configs
            if isinstance(config.scheduler, ReduceLROnPlateau)
        ]
        for name, monitor in monitors:
            if str(monitor).startswith("val") and monitor not in logged:
                raise SettingError(
                    name,
                    found=monitor,
                    expected=f"one of {', '.join(sorted(logged))}",
                    remedy="Your own callback can log it in on_validation_epoch_end.",
                )

    test_step = validation_step
    on_test_epoch_end = on_validation_epoch_end

    def on_train_epoch_end(self) -> None:
        """Step `ReduceLROnPlateau` before the checkpoint of the epoch is saved.

        Lightning would step it afterwards, so that the checkpoint would not contain the step.

        Raises:
            SettingError: The monitored value is not logged.
        """
        for config in self.trainer.lr_scheduler_configs:
            is_due = (self.current_epoch + 1) % config.frequency == 0
            if not (is_due and isinstance(config.scheduler, ReduceLROnPlateau)):
                continue
            logged = self.trainer.callback_metrics
            if config.monitor not in logged:
                raise SettingError(
                    "scheduler.monitor",
                    found=f"{config.monitor} after epoch {self.current_epoch + 1}",
                    expected=f"one of {', '.join(logged)}",
                    remedy="For a score: scheduler.frequency=${trainer.check_val_every_n_epoch}",
                )
            config.scheduler.step(logged[str(config.monitor)])

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """Step schedulers as Lightning does, except for `ReduceLROnPlateau`."""
        if not isinstance(scheduler, ReduceLROnPlateau):
            super().lr_scheduler_step(scheduler, metric)

    def configure_optimizers(self) -> Any:
        """Build the optimizer, and the scheduler if there is one.

        Raises:
            SettingError: The schedule ends before the training.
        """
        if self.schedule is not None:
            self.schedule.check_length(self._length())
        return self.optimization(self._length)

    def optimization(self, length: Callable[[], Mapping[str, int]]) -> Any:
        """Build optimizer and scheduler for a length of the training, see `Schedule.configure`."""
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
        configured = self.schedule.configure(optimizer, length, factors, self.monitor, self.mode_of)
        return {"optimizer": optimizer, "lr_scheduler": configured}

    def _length(self) -> dict[str, int]:
        """Return the planned steps and epochs of the training; −1 without an end."""
        trainer = self.trainer
        steps = trainer.estimated_stepping_batches
        per_epoch = trainer.num_training_batches / trainer.accumulate_grad_batches
        per_epoch = math.ceil(per_epoch) if math.isfinite(per_epoch) else per_epoch
        if not math.isfinite(steps):
            return {"step": -1, "epoch": -1}
        return {"step": int(steps), "epoch": math.ceil(steps / max(per_epoch, 1))}

    def checked_scores(self, scores: Any, expected: tuple[int, ...]) -> Tensor:
        """Return the network's scores if they have the expected shape.

        Raises:
            SettingError: The scores have another shape.
        """
        found = tuple(scores.shape) if isinstance(scores, Tensor) else type(scores).__name__
        if found != expected:
            raise SettingError(
                "scores of the network",
                found=found,
                expected=expected,
                remedy="Set network.num_classes to the number of classes, or to null.",
            )
        checked: Tensor = scores
        return checked
