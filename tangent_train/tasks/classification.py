"""Classification of whole spheres: shapes seen through all of their images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from datamodules.core.split_module import Kind
from tangent_train.errors import SettingError
from tangent_train.metrics.classification import ClassCounts, classification_scores
from tangent_train.registry import registered
from tangent_train.tasks.base import Part, Task

__all__ = ["ClassificationTask"]


@registered
class ClassificationTask(Task):
    """Trains a network that names a shape by all views of its sphere (paper, section 4.1).

    The loss is the cross-entropy, a mean over the shapes of the batch on all processes; in chunks
    of whole shapes, if asked for, with the same gradient (batch normalization then sees one chunk
    at a time). Validation and test count every shape once.

    Args:
        network: Any module ``(B, N, C, h, w) -> (B, K)``: N views of each of B shapes.
        representation: What made the views.
        class_names: K names.
        optimizer: Makes the optimizer from parameters.
        scheduler: Makes a learning rate scheduler from the optimizer, or None. When it takes
            `total_steps`, it is told the length of the training and stepped every step.
        label_smoothing: Share of the target spread over all classes.
        images_per_chunk: Views trained at once, a bound on memory: rounded down to whole shapes, at
            least one. None for the whole batch.
        channels_last: Memory format of the network, often faster.
        compile: Arguments of `torch.compile` for the network, empty for its defaults; None not to.

    Attributes:
        matrix: ``(K, K)`` counts of the last evaluation, rows truth, columns prediction.
    """

    kind: ClassVar[Kind] = "classification"
    monitor: ClassVar[str] = "val/accuracy"
    takes: ClassVar[str] = "views of shapes (B, N, C, h, w) to scores of classes (B, K)"

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
        self.counts = ClassCounts(len(self.class_names))

    def forward(
        self, images: Float[Tensor, "shapes views channels height width"]
    ) -> Float[Tensor, "shapes classes"]:
        """Scores of the classes.

        Raises:
            SettingError: The network's scores do not fit the shapes or the classes.
        """
        scores = self.network(images)
        expected = (images.shape[0], len(self.class_names))
        found = tuple(scores.shape) if isinstance(scores, Tensor) else type(scores).__name__
        if found != expected:
            raise SettingError(
                "scores of the network",
                found=found,
                expected=expected,
                remedy="Set network.num_classes to the number of classes, or to null.",
            )
        return scores

    def example(self, channels: int) -> Tensor:
        """All views of one empty shape ``(1, N, C, h, w)``."""
        grid = getattr(self.representation, "grid", None)  # equirectangular images are one
        views = 1 if grid is None else grid.num_images
        return torch.zeros(1, views, channels, *self.representation.image_size)

    def training_labels(self, batch: Any) -> Tensor:
        """Classes of the shapes ``(B,)``."""
        labels: Tensor = batch.label
        return labels

    def training_parts(self, batch: Any) -> list[Part]:
        """Whole shapes, their views ``(b, N, C, h, w)`` as many as `images_per_chunk` allows."""
        views = batch.images
        size = len(views)
        if self.images_per_chunk is not None:
            size = max(1, self.images_per_chunk // views.shape[1])
        parts = zip(torch.split(views, size), torch.split(batch.label, size), strict=True)
        return [((inputs,), labels) for inputs, labels in parts]

    def loss_sum(self, inputs: tuple[Tensor, ...], labels: Tensor) -> Tensor:
        """Cross-entropy, summed over the shapes."""
        scores = self(*inputs)
        exact = torch.promote_types(scores.dtype, torch.float32)
        return functional.cross_entropy(
            scores.to(exact), labels, reduction="sum", label_smoothing=self.label_smoothing
        )

    def loss_norm(self, labels: Tensor) -> Tensor:
        """The number of shapes."""
        return torch.tensor(float(len(labels)), device=labels.device)

    def evaluate(self, batch: Any) -> Tensor:
        """Count a batch of shapes; returns the predictions ``(B,)``."""
        prediction = self(batch.images).argmax(dim=1)
        self.counts.update(prediction, batch.label)
        return prediction

    def log_scores(self, stage: str) -> None:
        """Log the accuracies of a split and keep its matrix for the results."""
        self.matrix = self.counts.compute()
        self.counts.reset()
        scores = classification_scores(self.matrix)
        # Every process has the same number: the mean over processes changes nothing.
        self.log(f"{stage}/accuracy", scores.accuracy, prog_bar=stage == "val", sync_dist=True)
        self.log(f"{stage}/class_accuracy", scores.class_accuracy, sync_dist=True)
