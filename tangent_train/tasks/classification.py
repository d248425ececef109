"""Classification of shapes from all images of their spheres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from datamodules.core.labels import IMAGE_CLASS
from tangent_train.metrics.classification import ClassificationMetric, classification_scores
from tangent_train.metrics.score_columns import ScoreColumn
from tangent_train.results.evaluation import class_entries
from tangent_train.results.evaluation_result import EvaluationResult
from tangent_train.tasks.base import Task


class ClassificationTask(Task):
    """Trains a network that classifies a shape by all views of its sphere (paper, section 4.1).

    The loss is the mean cross-entropy over the shapes of the batch on all processes; with
    `view_batch_size`, in chunks of whole shapes. The arguments are those of `Task`; the network is
    a module ``(B, N, C, h, w) -> (B, K)`` that takes N views of each of B shapes.

    Attributes:
        result: Counts ``(K, K)`` of the last evaluation; rows are true, columns predicted classes.
    """

    labels: ClassVar[str] = IMAGE_CLASS
    predicts: ClassVar[str] = IMAGE_CLASS
    columns: ClassVar[Mapping[str, ScoreColumn]] = {
        "accuracy": ScoreColumn("accuracy"),
        "class_accuracy": ScoreColumn("mean over classes", "%", "accuracy", "accuracy"),
    }
    monitor: ClassVar[str] = "val/accuracy"
    takes: ClassVar[str] = "views of shapes (B, N, C, h, w) to scores of classes (B, K)"

    def forward(
        self, images: Float[Tensor, "shapes views channels height width"]
    ) -> Float[Tensor, "shapes classes"]:
        """Return the scores of the classes.

        Raises:
            SettingError: The shape of the scores does not fit the inputs or the classes.
        """
        return self.checked_scores(self.network(images), (len(images), len(self.class_names)))

    def example(self, channels: int) -> Tensor:
        """Return all views of one empty shape ``(1, N, C, h, w)``."""
        grid = getattr(self.representation, "grid", None)  # an equirectangular image is one view
        views = 1 if grid is None else grid.num_images
        return torch.zeros(1, views, channels, *self.representation.image_size)

    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return the views ``(B, N, C, h, w)`` and classes ``(B,)`` of shapes."""
        return batch.images, batch.label

    def loss_sum(self, inputs: tuple[Tensor, ...], labels: Tensor) -> Tensor:
        """Return the cross-entropy, summed over the shapes."""
        return self._cross_entropy(self(*inputs), labels)

    def _cross_entropy(self, scores: Tensor, labels: Tensor) -> Tensor:
        exact = torch.promote_types(scores.dtype, torch.float32)
        return functional.cross_entropy(
            scores.to(exact), labels, reduction="sum", label_smoothing=self.label_smoothing
        )

    def loss_norm(self, labels: Tensor) -> Tensor:
        """Return the number of shapes."""
        return torch.full((), float(len(labels)), device=labels.device)

    def evaluate(self, batch: Any) -> Tensor:
        """Add a batch of shapes to `metric`; return the predictions ``(B,)``."""
        scores = self(batch.images)
        if not self.is_tested:
            self.add_validation_loss(self._cross_entropy(scores, batch.label), batch.label)
        prediction = scores.argmax(dim=1)
        self.metric.update(prediction, batch.label)
        return prediction

    def targets(self, batch: Any) -> Tensor:
        """Return the true classes ``(B,)``."""
        labels: Tensor = batch.label
        return labels

    def build_metric(self) -> ClassificationMetric:
        """Build the confusion matrix of whole shapes."""
        return ClassificationMetric(len(self.class_names))

    def logged_scores(self, result: Any) -> dict[str, float]:
        """Return the accuracy over shapes, and its mean over classes."""
        scores = classification_scores(result)
        return {"accuracy": scores.accuracy, "class_accuracy": scores.class_accuracy}

    def class_scores(self, result: Any) -> dict[str, float]:
        """Return the accuracy of each class."""
        scores = classification_scores(result).of_class.tolist()
        return {f"accuracy/{n}": s for n, s in zip(self.class_names, scores, strict=True)}

    def evaluation_result(self, result: Any, noun: str) -> EvaluationResult:
        """Return the record with the accuracy of every class and the confusion matrix."""
        scores = classification_scores(result)
        columns = {"images": scores.counts, "accuracy": scores.of_class}
        return replace(
            super().evaluation_result(result, noun),
            classes=class_entries(columns, result, self.class_names),
            confusion=result.tolist(),
        )
