"""LightningModules: the gradient of a step, optimizer and schedule, and the scores of a split."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any, Self

import lightning
import torch
from numpy.typing import NDArray
from pydantic import PositiveInt
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler, ReduceLROnPlateau

from datamodules.core.dataset import Sample, valid_mask
from tangent_train.checkpoints.outputs import network_for_views
from tangent_train.errors import SettingError
from tangent_train.heads import Head
from tangent_train.inference.engine import add_views, scored_views, upright_rays
from tangent_train.tasks.divergence import check_loss, check_weights
from tangent_train.tasks.optimization import Schedule, freeze, parameter_groups

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
        auxiliary_weight: Weight of the loss of the auxiliary output, which counts in training only.
        eval_view_batch_size: Number of images per forward pass in evaluation, which bounds memory.

    Attributes:
        monitor: Score on the validation split that selects the best epoch.
        metric: Metric of a split, see `Head.build_metric`.
        result: Value of `metric` after the last evaluation.
        evaluated: Number of images or shapes in that evaluation.
        confidences: Confidence of the labels of panoramas ``(H, W)``, to which `evaluate` appends
            those whose mosaics keep probabilities; None to leave them out.
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
        view_batch_size: PositiveInt | None = None,
        channels_last: bool = False,
        compile: Mapping[str, Any] | None = None,  # noqa: A002 - torch's own word
        frozen: Sequence[str] = (),
        backbone_lr_factor: float = 1.0,
        auxiliary_weight: float = 0.4,
        eval_view_batch_size: PositiveInt = 32,
    ) -> None:
        super().__init__()
        self.memory_format = torch.channels_last if channels_last else torch.contiguous_format
        network = network_for_views(network, getattr(representation, "distortion_aware", None))
        self.network: nn.Module = network.to(memory_format=self.memory_format)
        if compile is not None:
            self.network.compile(**compile)  # in place: names of tensors stay as they are
        self.representation, self.head = representation, head
        self.make_optimizer: Any = optimizer
        self.schedule, self.backbone_lr_factor = scheduler, backbone_lr_factor
        self._schedule_length: float | None = None
        self.view_batch_size = view_batch_size
        self.auxiliary_weight = auxiliary_weight
        self.eval_view_batch_size = eval_view_batch_size
        head.num_outputs = getattr(network, "num_outputs", head.num_outputs)
        self.fresh: Collection[str] | None = None
        # A tuple: in a `ModuleList`, their tensors would have second names.
        self._frozen = tuple(freeze(self.network, frozen))
        self.monitor = f"val/{head.main_score}"
        self.metric: Any = head.build_metric()
        self.confidences: list[Any] | None = None
        # Images, validation loss and its norm: not a buffer, which would be of half precision.
        self._sums = torch.zeros(3)
        self._pending: tuple[Tensor, Any, Any] | None = None
        self._step_norm: Any = None

    @abstractmethod
    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return the inputs of the network and their targets, with a common first dimension."""

    @abstractmethod
    def evaluate(self, batch: Any) -> Tensor:
        """Add the predictions for a batch to `metric` and return them."""

    def loss_sum(self, outputs: Any, targets: Tensor) -> Tensor:
        """Return the sum of the losses, in training and in validation (``val/loss``).

        Args:
            outputs: Result of `forward`.
            targets: Targets of `training_pairs`.
        """
        return self.head.loss_sum(outputs, targets)

    # Training

    def training_parts(self, batch: Any) -> list[Part]:
        """Divide a batch into even parts of at most `view_batch_size` images, at least one input.

        Batch normalization fails on a single value per channel: 20 images in parts of at most 19
        are divided into 10 and 10, not 19 and 1.
        """
        inputs, targets = self.training_pairs(batch)
        size = self.view_batch_size or inputs.shape[:-3].numel()
        count = -(-len(inputs) // max(1, size // inputs.shape[1:-3].numel()))
        parts = zip(inputs.tensor_split(count), targets.tensor_split(count), strict=True)
        return [((images,), of_images) for images, of_images in parts]

    def on_train_start(self) -> None:
        """Log at least once per epoch, and once per training, however few steps it has."""
        trainer: Any = self.trainer
        per_epoch = trainer.num_training_batches / trainer.accumulate_grad_batches  # may be inf
        every = min(trainer.log_every_n_steps, per_epoch, trainer.estimated_stepping_batches)
        trainer.log_every_n_steps = math.ceil(every)

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
            loss = self.loss_sum(self(*part[0]), part[1])
            strategy.backward(loss / self._step_norm, None)
            value += loss.detach()
        loss = self.loss_sum(self(*last[0]), last[1])
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
        check_loss(self, float(loss), batch)
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
        checkpoint["schedule_length"] = self._schedule_length
        if self.fresh is not None:
            checkpoint["fresh"] = sorted(self.fresh)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Restore `fresh`, before the optimizer is built."""
        self._schedule_length = checkpoint.get("schedule_length")
        fresh = checkpoint.get("fresh")
        self.fresh = None if fresh is None else frozenset(map(str, fresh))

    # Evaluation

    def add_validation_loss(self, outputs: Any, targets: Tensor) -> None:
        """Add to ``val/loss``, which is normalized like the training loss; not in a test."""
        if not self.is_tested:
            self._sums[1] += self.loss_sum(outputs, targets)
            self._sums[2] += self.head.loss_norm(targets)

    @property
    def is_tested(self) -> bool:
        """True during a test, in which no loss is computed."""
        return self._trainer is not None and self._trainer.testing

    def on_validation_epoch_start(self) -> None:
        """Reset the metric."""
        self._sums = torch.zeros(3, device=self.device)

    def validation_step(self, batch: Any, batch_idx: int) -> Tensor:
        """Evaluate a batch of the validation or test split."""
        predictions = self.evaluate(batch)
        self._sums[0] += len(predictions)
        return predictions

    def on_validation_epoch_end(self) -> None:
        """Log the scores of the validation or test split."""
        # All processes have the same values, which a mean over processes does not change. A process
        # without images takes part too.
        sums = self.trainer.strategy.reduce(self._sums, reduce_op="sum")
        self.result, self.evaluated = self.metric.compute(), int(sums[0])
        self.metric.reset()
        scores, stage = self.head.scores(self.result), "test" if self.is_tested else "val"
        logged = {f"{stage}/{name}": score for name, score in scores.means.items()}
        if not self.is_tested:
            logged["val/loss"] = float(sums[1] / sums[2])
        of_class = next(filter(None, (self.head.columns[n].of_class for n in scores.means)), None)
        if of_class is not None:
            values = scores.of_classes[of_class].tolist()
            names = self.head.class_names[-len(values) :]
            of_classes = {n: v for n, v in zip(names, values, strict=True) if not math.isnan(v)}
            logged |= {f"{stage}_{of_class}/{name}": score for name, score in of_classes.items()}
        for name, score in logged.items():
            self.log(name, score, prog_bar=name == self.monitor, sync_dist=True)

    on_test_epoch_start = on_validation_epoch_start
    test_step = validation_step
    on_test_epoch_end = on_validation_epoch_end

    # Optimizer and schedule

    def configure_optimizers(self) -> Any:
        """Build the optimizer, and the scheduler if there is one.

        Raises:
            SettingError: The schedule of a resumed training ends at another step.
        """
        groups = parameter_groups(self.network, self.fresh or (), self.backbone_lr_factor)
        optimizer = self.make_optimizer(groups)
        for group in optimizer.param_groups:
            group["lr"] *= group.get("lr_factor", 1)
        schedule = self.schedule
        if schedule is None:
            return optimizer
        schedule = schedule if isinstance(schedule, Schedule) else Schedule(schedule)
        before, self._schedule_length = self._schedule_length, schedule.length(self.trainer)
        if before not in (None, self._schedule_length):
            name, found = "length of the training", f"{self._schedule_length} {schedule.interval}s"
            expected = f"{before}, when resuming: the end of the schedule"
            remedy = "Start a new run: init_from=<run>/checkpoints/last.ckpt"
            raise SettingError(name, found=found, expected=expected, remedy=remedy)
        built = schedule.configure(optimizer, self.trainer, self.monitor, self.head.mode_of)
        return {"optimizer": optimizer, "lr_scheduler": built}

    def on_train_epoch_end(self) -> None:
        """Step `ReduceLROnPlateau` before the checkpoint of the epoch is saved.

        Lightning would step it afterwards, so that the checkpoint would not contain the step.
        """
        for config in self.trainer.lr_scheduler_configs:
            is_due = (self.current_epoch + 1) % config.frequency == 0
            if is_due and isinstance(config.scheduler, ReduceLROnPlateau):
                name, logged = str(config.monitor), self.trainer.callback_metrics
                if name not in logged:
                    expected = f"one of {', '.join(sorted(logged))}"
                    raise SettingError("scheduler.monitor", found=name, expected=expected)
                config.scheduler.step(logged[name])

    def lr_scheduler_step(self, scheduler: Any, metric: Any) -> None:
        """Step schedulers as Lightning does, except for `ReduceLROnPlateau`."""
        if not isinstance(scheduler, ReduceLROnPlateau):
            super().lr_scheduler_step(scheduler, metric)


class PixelTask(Task):
    """Trains a network on views of panoramas, or on crops of photos, and scores whole images.

    The views of all images of a batch, on all processes, contribute to one gradient (paper,
    supplement, "Semantic segmentation"). Validation and test cover the whole sphere, or the whole
    photo; the outputs are merged and compared with the original labels.

    The network is a module ``(B, C, h, w) -> (B, K, h, w)``, or one that returns a dict with this
    output under ``"out"`` and optionally that of an auxiliary head under ``"aux"``. The
    arguments are those of `Task`.
    """

    def forward(self, images: Tensor, rays: Tensor | None = None) -> Mapping[str, Tensor]:
        """Return the outputs of the network at every pixel by name: ``out``, optionally ``aux``.

        Args:
            images: Images ``(n, C, h, w)`` of one or several spheres.
            rays: Viewing rays ``(1, N, 3, 3)`` for networks that take cameras, see `Views.rays`.

        Raises:
            SettingError: The shape of the output does not fit the images or the labels.
        """
        images = images.contiguous(memory_format=self.memory_format)
        returned = self.network(images) if rays is None else self.network(images, rays)
        outputs = returned if isinstance(returned, Mapping) else {"out": returned}
        found = tuple(outputs["out"].shape)
        expected = (len(images), self.head.num_outputs, *images.shape[-2:])
        if found != expected:
            remedy = (
                "A network returns the scores of all classes (network.num_classes, or null for "
                "those of the data) for every pixel of its input."
            )
            raise SettingError(
                "output of the network", found=found, expected=expected, remedy=remedy
            )
        return outputs

    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return all images of a batch ``(n, C, h, w)`` and their targets, see `Head.targets`."""
        truth = self.head.truth(batch.labels.flatten(0, 1))
        lengths = batch.ray_lengths.expand(*batch.labels.shape[:2], *batch.ray_lengths.shape[-2:])
        return batch.images.flatten(0, 1), self.head.targets(truth, lengths.flatten(0, 1))

    def loss_sum(self, outputs: Mapping[str, Tensor], targets: Tensor) -> Tensor:
        """Return the loss, summed over pixels; in training with that of an auxiliary output.

        Args:
            outputs: Outputs of the network by name, see `forward`.
            targets: Correct outputs, see `Head.targets`.
        """
        loss = self.head.loss_sum(outputs["out"], targets)
        if "aux" not in outputs or not self.training:
            return loss
        return loss + self.auxiliary_weight * self.head.auxiliary_sum(outputs["aux"], targets)

    def _evaluated_views(self, sets: Iterable[Any]) -> Iterator[tuple[Any, Tensor, Any]]:
        """Yield views, their scores (see `scored_views`), and all outputs, for `loss_sum`."""
        how = self.eval_view_batch_size, getattr(self.network, "takes_all_views", False)
        for views, scores, outputs in scored_views(self, sets, *how):
            yield views, scores, {**outputs, "out": scores}

    @torch.no_grad()
    def evaluate(self, batch: Any) -> Tensor:
        """Add a batch of panoramas or photos to `metric`; return the predictions."""
        predictions = []
        for fields in zip(*batch, strict=True):
            sample: Sample[Tensor] = Sample(*fields)
            truth, lengths = self.head.truth(sample.labels), None
            if truth.ndim == 2:
                where = sample.rotation.cpu().numpy(), valid_mask(sample.valid)
                predicted = self.predict_panorama(sample.images, tuple(truth.shape), *where, truth)
            else:
                lengths = sample.ray_lengths.expand(len(truth), *sample.ray_lengths.shape[-2:])
                predicted = self.predict_crops(sample.images, truth, lengths)
            predictions.append(self.head.comparable(predicted, truth, lengths))
            self.metric.update(predictions[-1], truth)
        return torch.stack(predictions)

    def predict_crops(self, images: Tensor, truth: Tensor, lengths: Tensor) -> Tensor:
        """Predict the crops of a photo ``(n, h, w)``; see `predict_panorama`."""
        predictions, crops = [], range(len(truth))
        for numbers, scores, outputs in self._evaluated_views([(crops, images.__getitem__, None)]):
            part = slice(numbers.start, numbers.stop)
            predictions.append(self.head.crop_pixels(scores, lengths[part]))
            self.add_validation_loss(outputs, self.head.targets(truth[part], lengths[part]))
        return torch.cat(predictions)

    def predict_panorama(
        self,
        images: Tensor,
        shape: Any,
        rotation: NDArray[Any] | None = None,
        valid: NDArray[Any] | None = None,
        truth: Tensor | None = None,
    ) -> Tensor:
        """Predict every pixel of a panorama, see `Head`.

        Args:
            images: Images ``(n, C, h, w)`` of all view sets of the representation, in this order.
            shape: ``(H, W)`` of the panorama.
            rotation: Rotation of the representation ``(3, 3)``.
            valid: ``(H, W)`` valid pixels of a partial panorama; None if all are valid.
            truth: Result of `Head.truth`, to add to the validation loss, except in a test.
        """
        rotated = self.representation
        if rotation is not None:
            rotated = rotated.with_rotation(rotation)
        sets = rotated.view_sets(valid)
        readers = (part.__getitem__ for part in torch.split(images, [len(views) for views in sets]))
        rays: Iterable[Any] = [None] * len(sets)
        if getattr(self.network, "takes_cameras", False):
            rays = upright_rays(sets, rotation, images.device)
        how: dict[str, Any] = {"averaged": len(sets) > 1, "device": images.device}
        mosaic = self.head.mosaic(shape, self.representation.blend, valid=valid, **how)
        view_sets = zip(sets, readers, rays, strict=True)
        for views, scores, outputs in self._evaluated_views(view_sets):
            add_views(mosaic, views, scores, outputs)
            if truth is not None and not self.is_tested:
                lengths = torch.from_numpy(views.ray_lengths()).to(scores.device)
                targets = self.head.targets(_labels_of_views(truth, views), lengths)
                self.add_validation_loss(outputs, targets)
        if self.confidences is not None and getattr(mosaic, "has_probabilities", False):
            self.confidences.append(mosaic.confidences())
        return mosaic.pixels().to(images.device)


def _labels_of_views(target: Tensor, views: Any) -> Tensor:
    """Render the labels of a panorama ``(H, W)`` to views ``(n, h, w)``."""
    if target.is_cpu:
        return torch.from_numpy(views.render(target.numpy(), "nearest"))
    rendered: Tensor = views.render(target[None], "nearest")
    return rendered[:, 0]


class ShapeTask(Task):
    """Trains a network that classifies a shape by all views of its sphere (paper, section 4.1).

    With `view_batch_size`, a step is computed in chunks of whole shapes. The network is a module
    ``(B, N, C, h, w) -> (B, K)`` that takes N views of each of B shapes; the arguments are those of
    `Task`.
    """

    def forward(self, images: Tensor) -> Tensor:
        """Return the logits ``(B, K)`` of views ``(B, N, C, h, w)``."""
        logits: Tensor = self.network(images)
        return logits

    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return the views ``(B, N, C, h, w)`` and classes ``(B,)`` of shapes."""
        return batch.images, batch.labels

    def evaluate(self, batch: Any) -> Tensor:
        """Add a batch of shapes to `metric`; return the predictions ``(B,)``."""
        logits = self(batch.images)
        self.add_validation_loss(logits, batch.labels)
        prediction = logits.argmax(dim=1)
        self.metric.update(prediction, batch.labels)
        return prediction
