"""Semantic segmentation of panoramas and photos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float, Integer
from lightning.pytorch.callbacks import Callback
from rich.table import Table
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from datamodules.split_module import Kind
from tangent_train.errors import SettingError
from tangent_train.rendering import Assembler
from tangent_train.tasks.base import Task, check_at_once
from tangent_train.tasks.callbacks import PredictionPanels
from tangent_train.tasks.html.evaluation import write_evaluation_report
from tangent_train.tasks.losses import cross_entropy_norm, cross_entropy_sum
from tangent_train.tasks.metrics import AbsentClass, ConfusionMatrix, segmentation_scores
from tangent_train.tasks.results import evaluation_results, results_table, write_results
from tangent_train.tasks.tensorboard_pictures import ValidationPictures

__all__ = ["SegmentationTask"]


class SegmentationTask(Task):
    """Trains a network on views of panoramas, or on crops of photos, and scores it on the whole.

    The views of all images of a batch, on all processes, make one gradient (paper, supplement,
    "Semantic segmentation"): the loss is the sum over their labelled pixels divided by the sum of
    those pixels' class weights. `images_per_chunk` bounds the memory that takes; the gradient stays
    the same, but batch normalization sees one chunk at a time. Validation and test see the whole
    sphere, or all of a photo; the scores are rendered back and compared with its own labels.

    Args:
        network: Any module ``(B, C, h, w) -> (B, K+1, h, w)`` or a dict with that under ``"out"``;
            the first score belongs to the unknown class, which is never predicted.
        representation: What made the images; it assembles the scores.
        class_names: K + 1 names, the unknown class first.
        optimizer: Makes the optimizer from parameters.
        scheduler: Makes a learning rate scheduler from the optimizer, or None. When it takes
            `total_steps`, it is told the length of the training and stepped every step.
        class_weights: Weights of the loss: a name that the data module knows (``none``, ``log``,
            ``sqrt``) or K + 1 numbers.
        label_smoothing: Share of the target spread over all classes.
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
        class_weights: Literal["none", "log", "sqrt"] | Sequence[float] = "log",
        label_smoothing: float = 0.0,
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
        self.weighting = class_weights
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
        weights = torch.as_tensor(weights, dtype=torch.float32)
        if weights.shape != self.class_weights.shape:
            raise SettingError(
                "task.class_weights",
                found=f"{weights.numel()} numbers",
                expected=f"{len(self.class_names)}, one for each of {', '.join(self.class_names)}",
            )
        self.class_weights.copy_(weights)

    def forward(
        self, images: Float[Tensor, "images channels height width"]
    ) -> Float[Tensor, "images classes height width"]:
        """Scores of every pixel, the unknown class first.

        Raises:
            SettingError: The network's scores do not fit the images or the classes.
        """
        scores = self.network(images.contiguous(memory_format=self.memory_format))
        if isinstance(scores, dict):
            scores = scores["out"]
        expected = (images.shape[0], len(self.class_names), *images.shape[-2:])
        if tuple(scores.shape) != expected:
            raise SettingError(
                "scores of the network",
                found=tuple(scores.shape),
                expected=expected,
                remedy="Set network.num_classes to the number of classes, unknown included.",
            )
        return scores

    def example(self, channels: int) -> Tensor:
        """One empty image ``(1, C, h, w)``."""
        return torch.zeros(1, channels, *self.representation.image_size)

    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Images of all panoramas or photos ``(n, C, h, w)``, and their labels ``(n, h, w)``."""
        return batch.images.flatten(0, 1), batch.labels.flatten(0, 1)

    def loss_sum(self, scores: Tensor, labels: Tensor) -> Tensor:
        """Weighted cross-entropy of the labelled pixels, summed."""
        return cross_entropy_sum(scores, labels, self.class_weights, self.label_smoothing)

    def loss_norm(self, labels: Tensor) -> Tensor:
        """The class weights of the labelled pixels, added up."""
        return cross_entropy_norm(labels, self.class_weights)

    @torch.no_grad()
    def predict_labels(
        self, images: Float[Tensor, "images channels height width"], shape: tuple[int, ...]
    ) -> Integer[Tensor, ...]:
        """Class index (never unknown) of every pixel of one panorama, or of the crops of a photo.

        Args:
            images: The representation's views of the whole.
            shape: Of the truth: ``(H, W)`` of the panorama, or ``(n, h, w)`` of the crops.

        Returns:
            Class indices 1 … K of that shape.
        """
        size = self.images_per_forward
        parts = [images[start : start + size] for start in range(0, len(images), size)]
        scores = torch.cat([self(part)[:, 1:].float() for part in parts])
        return self.representation.to_labels(scores, shape) + 1

    def evaluate(self, batch: Any) -> Tensor:
        """Count a batch of panoramas or photos; returns the predictions."""
        predictions = [
            self.predict_labels(images, tuple(target.shape))
            for images, target in zip(batch.images, batch.target, strict=True)
        ]
        for prediction, target in zip(predictions, batch.target, strict=True):
            self.confusion.update(prediction, target)
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

    def pictures(self, folder: Path, settings: Mapping[str, Any]) -> list[Callback]:
        """Panels of test images, and pictures of validation images for TensorBoard."""
        shown = settings.get("tensorboard_images", 0)  # configs of older runs do not have it
        return [PredictionPanels(folder / "panels", settings["panels"]), ValidationPictures(shown)]

    def results(self, noun: str) -> dict[str, Any]:
        """See `results.evaluation_results`."""
        return evaluation_results(self.matrices, self.class_names, self.absent_class, noun)

    def write_results(self, results: dict[str, Any], folder: Path) -> Table:
        """Write ``results.json``, ``.csv`` and ``.md``; returns the table per class."""
        write_results(results, folder)
        return results_table(results)

    def write_page(self, path: Path, results: dict[str, Any], checkpoint: Path) -> None:
        """Write them with a viewer of the panels' images."""
        callbacks: list[Any] = self.trainer.callbacks  # type: ignore[attr-defined]
        images = [i for c in callbacks if isinstance(c, PredictionPanels) for i in c.images]
        write_evaluation_report(path, results, self.class_names, images, checkpoint)
