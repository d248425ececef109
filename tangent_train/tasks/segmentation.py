"""Semantic segmentation of panoramas and photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, get_args

import torch
from jaxtyping import Float, Integer
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from datamodules.core.class_weights import ClassWeights
from datamodules.core.split_module import Kind
from tangent_train.errors import SettingError
from tangent_train.inference.predictor import sees_rays, view_scores
from tangent_train.metrics.segmentation import AbsentClass, ConfusionMatrix, segmentation_scores
from tangent_train.registry import registered
from tangent_train.rendering import Assembler, EquirectRepresentation
from tangent_train.tasks.base import Part, Task, check_at_once
from tangent_train.tasks.losses import (
    AuxiliaryTarget,
    auxiliary_sum,
    cross_entropy_norm,
    cross_entropy_sum,
)

__all__ = ["SegmentationTask"]


@registered
class SegmentationTask(Task):
    """Trains a network on views of panoramas, or on crops of photos, and scores it on the whole.

    The views of all images of a batch, on all processes, make one gradient (paper, supplement,
    "Semantic segmentation"): the loss is the sum over their labelled pixels divided by the sum of
    those pixels' class weights. `images_per_chunk` bounds the memory that takes; the gradient stays
    the same, but batch normalization sees one chunk at a time. Validation and test see the whole
    sphere, or all of a photo; the scores are rendered back and compared with its own labels.

    Args:
        network: Any module ``(B, C, h, w) -> (B, K+1, h, w)`` or a dict with that under ``"out"``,
            and perhaps scores of an auxiliary head under ``"aux"``; the first score belongs to the
            unknown class, which is never predicted. One whose `forward` also takes ``rays`` and
            ``images_per_chunk`` is told where on the sphere its images look, and bounds its memory
            itself (`models.SphereContext`).
        representation: What made the images; it assembles the scores.
        class_names: K + 1 names, the unknown class first.
        optimizer: Makes the optimizer from parameters.
        scheduler: Makes a learning rate scheduler from the optimizer, or None. When it takes
            `total_steps`, it is told the length of the training and stepped every step.
        class_weights: Weights of the loss: a name that the data module knows (``none``, ``log``,
            ``sqrt``, ``effective``) or K + 1 numbers.
        label_smoothing: Share of the target spread over all classes.
        auxiliary_weight: Of the loss of the scores under ``"aux"``.
        auxiliary_target: What those are compared with, see `losses.auxiliary_sum`.
        images_per_chunk: Images trained at once, a bound on memory; None for the whole batch.
        images_per_forward: Images evaluated at once, a bound on memory; training is not affected.
        absent_class: What classes absent from the truth do to the means.
        channels_last: Memory format of network and images, often faster.
        compile: Arguments of `torch.compile` for the network, empty for its defaults; None not to.
    """

    kind: ClassVar[Kind] = "segmentation"
    monitor: ClassVar[str] = "val/miou"
    takes: ClassVar[str] = "images (n, C, h, w) to scores of every pixel (n, K + 1, h, w)"
    class_weights: Tensor
    representation: Assembler

    def __init__(
        self,
        network: nn.Module,
        representation: Assembler,
        class_names: Sequence[str],
        optimizer: Callable[..., Optimizer],
        scheduler: Callable[..., LRScheduler] | None = None,
        class_weights: ClassWeights | Sequence[float] = "log",
        label_smoothing: float = 0.0,
        auxiliary_weight: float = 0.4,
        auxiliary_target: AuxiliaryTarget = "histogram",
        images_per_chunk: int | None = None,
        images_per_forward: int = 32,
        absent_class: AbsentClass = "skip",
        channels_last: bool = False,
        compile: Mapping[str, Any] | None = None,  # noqa: A002 - torch's own word
    ) -> None:
        super().__init__(
            network,
            representation,
            class_names,
            optimizer,
            scheduler,
            label_smoothing=label_smoothing,
            images_per_chunk=images_per_chunk,
            channels_last=channels_last,
            compile=compile,
        )
        check_at_once("images_per_forward", images_per_forward)
        if absent_class not in ("skip", "zero"):
            raise SettingError("task.absent_class", found=absent_class, expected="skip or zero")
        _check_weighting(class_weights, self.class_names)
        self.weighting = class_weights
        if not auxiliary_weight >= 0:
            raise SettingError(
                "task.auxiliary_weight", found=auxiliary_weight, expected="0 or more"
            )
        if auxiliary_target not in get_args(AuxiliaryTarget):
            expected = " or ".join(get_args(AuxiliaryTarget))
            raise SettingError("task.auxiliary_target", found=auxiliary_target, expected=expected)
        self.auxiliary_weight = auxiliary_weight
        self.auxiliary_target: AuxiliaryTarget = auxiliary_target
        self.takes_rays = sees_rays(network)
        if self.takes_rays and isinstance(representation, EquirectRepresentation):
            raise SettingError(
                "representation",
                found="equirectangular images",
                expected="tangent images or a cube's for a network whose images see each other",
                remedy="One image sees all of itself: use the network without its context.",
            )
        self.images_per_forward = images_per_forward
        self.absent_class: AbsentClass = absent_class
        self.register_buffer("class_weights", torch.ones(len(self.class_names)))
        self.confusion = ConfusionMatrix(len(self.class_names))

    def setup(self, stage: str) -> None:
        """Fix the class weights before training; a checkpoint brings its own."""
        if stage != "fit" or self.trainer.ckpt_path:
            return
        weights: Any = self.weighting
        if isinstance(weights, str):
            weights = self.trainer.datamodule.class_weights(weights)  # type: ignore[attr-defined]
        self.class_weights.copy_(torch.as_tensor(weights, dtype=torch.float32))

    def forward(
        self,
        images: Float[Tensor, "images channels height width"],
        rays: Float[Tensor, "spheres of_each 3 3"] | None = None,
    ) -> Float[Tensor, "images classes height width"]:
        """Scores of every pixel, the unknown class first.

        Args:
            images: Of one or several spheres.
            rays: Where they look, see `Views.rays`, for networks that take it.

        Raises:
            SettingError: The network's scores do not fit the images or the classes.
        """
        return self.outputs(images, rays)["out"]

    def outputs(self, images: Tensor, rays: Tensor | None = None) -> Mapping[str, Tensor]:
        """All scores that the network returns, by name; see `forward`."""
        images = images.contiguous(memory_format=self.memory_format)
        if rays is None:
            returned = self.network(images)
        else:
            at_once = self.images_per_chunk if self.training else self.images_per_forward
            returned = self.network(images, rays, at_once)
        outputs: Mapping[str, Tensor] = (
            returned if isinstance(returned, dict) else {"out": returned}
        )
        scores = outputs["out"]
        expected = (images.shape[0], len(self.class_names), *images.shape[-2:])
        if tuple(scores.shape) != expected:
            raise SettingError(
                "scores of the network",
                found=tuple(scores.shape),
                expected=expected,
                remedy="Set network.num_classes to the number of classes, unknown included.",
            )
        return outputs

    def example(self, channels: int) -> Tensor:
        """One empty image ``(1, C, h, w)``."""
        return torch.zeros(1, channels, *self.representation.image_size)

    def training_labels(self, batch: Any) -> Tensor:
        """Labels of all images of all panoramas or photos ``(n, h, w)``."""
        labels: Tensor = batch.labels
        return labels.flatten(0, 1)

    def training_parts(self, batch: Any) -> list[Part]:
        """Images of all panoramas or photos ``(n, C, h, w)``, `images_per_chunk` at once.

        A network that takes rays gets all of them and divides them itself.
        """
        images, labels = batch.images.flatten(0, 1), self.training_labels(batch)
        if self.takes_rays and batch.rays.numel():
            return [((images, batch.rays), labels)]
        size = self.images_per_chunk or len(images)
        parts = zip(torch.split(images, size), torch.split(labels, size), strict=True)
        return [((part,), of_part) for part, of_part in parts]

    def loss_sum(self, inputs: tuple[Tensor, ...], labels: Tensor) -> Tensor:
        """Weighted cross-entropy, with that of an auxiliary head, summed over the pixels."""
        outputs, weights = self.outputs(*inputs), self.class_weights
        loss = cross_entropy_sum(outputs["out"], labels, weights, self.label_smoothing)
        if "aux" not in outputs:
            return loss
        auxiliary = auxiliary_sum(outputs["aux"], labels, weights, self.auxiliary_target)
        return loss + self.auxiliary_weight * auxiliary

    def loss_norm(self, labels: Tensor) -> Tensor:
        """The class weights of the labelled pixels, added up."""
        return cross_entropy_norm(labels, self.class_weights)

    @torch.no_grad()
    def predict_labels(
        self,
        images: Float[Tensor, "images channels height width"],
        shape: tuple[int, ...],
        rays: Float[Tensor, "images 3 3"] | None = None,
        rotations: Float[Tensor, "rotations 3 3"] | None = None,
    ) -> Integer[Tensor, ...]:
        """Class index (never unknown) of every pixel of one panorama, or of the crops of a photo.

        Args:
            images: The representation's views of the whole.
            shape: Of the truth: ``(H, W)`` of the panorama, or ``(n, h, w)`` of the crops.
            rays: Of the views.
            rotations: Of the views; by default they are not turned.

        Returns:
            Class indices 1 … K of that shape.
        """
        count = 1 if rotations is None else len(rotations)
        of_turns = [None] * count if rays is None else rays.chunk(count)
        scores = (self._scores(*part) for part in zip(images.chunk(count), of_turns, strict=True))
        turns = None if rotations is None else rotations.cpu().double().numpy()
        if turns is None or count == 1:
            turn = None if turns is None else turns[0]
            return self.representation.to_labels(next(scores), shape, turn) + 1
        representation: Any = self.representation  # one whose `whole` has several rotations
        labels: Tensor = representation.to_averaged_labels(scores, shape, turns)
        return labels.to(images.device) + 1

    def _scores(self, images: Tensor, rays: Tensor | None) -> Tensor:
        """Scores of all views of one rotation, see `view_scores`."""
        of_sphere = rays if self.takes_rays and rays is not None and rays.numel() else None
        parts = view_scores(
            self, lambda part: images[part], len(images), self.images_per_forward, of_sphere
        )
        return torch.cat([scores for _, scores in parts])

    def evaluate(self, batch: Any) -> Tensor:
        """Count a batch of panoramas or photos; returns the predictions."""
        predictions = []
        for images, target, rays, rotations in zip(
            batch.images, batch.target, batch.rays, batch.rotations, strict=True
        ):
            predictions.append(self.predict_labels(images, tuple(target.shape), rays, rotations))
            self.confusion.update(predictions[-1], target)
        return torch.stack(predictions)

    def log_scores(self, stage: str) -> None:
        """Log the scores of a split and keep its matrices for the results."""
        self.matrices = self.confusion.compute()
        self.confusion.reset()
        scores = {"": segmentation_scores(self.matrices.pixels, self.absent_class)}
        if self.matrices.solid_angle.any():
            score = segmentation_scores(self.matrices.solid_angle, self.absent_class)
            scores["_solid_angle"] = score
        for suffix, score in scores.items():
            on_bar = stage == "val" and not suffix
            # Every process has the same number: the mean over processes changes nothing.
            self.log(f"{stage}/miou{suffix}", score.miou, prog_bar=on_bar, sync_dist=True)
            self.log(f"{stage}/macc{suffix}", score.macc, sync_dist=True)


def _check_weighting(weighting: str | Sequence[float], class_names: Sequence[str]) -> None:
    kinds = ", ".join(get_args(ClassWeights))
    each = f"{len(class_names)} numbers, one for each of {', '.join(class_names)}"
    if isinstance(weighting, str):
        if weighting not in get_args(ClassWeights):
            expected = f"{kinds}; or {each}"
            raise SettingError("task.class_weights", found=weighting, expected=expected)
    elif len(weighting) != len(class_names):
        raise SettingError("task.class_weights", found=f"{len(weighting)} numbers", expected=each)
