"""Head for one class of an image or shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn import functional

from datamodules.core.label_map import IMAGE_CLASS
from tangent_train.heads.base import Head, Scores
from tangent_train.metrics.scores import ScoreColumn
from tangent_train.metrics.segmentation import ClassificationMetric, classification_scores


class ImageClassHead(Head):
    """One of K classes for a shape; output k of the network ``(n, K)`` is the logit of label k.

    Args:
        class_names: Names of the K classes.
        label_smoothing: Fraction of the target that is spread over all classes.
    """

    kind: ClassVar[str] = IMAGE_CLASS
    labels: ClassVar[str] = IMAGE_CLASS
    columns: ClassVar[Mapping[str, ScoreColumn]] = {
        "accuracy": ScoreColumn("accuracy"),
        "class_accuracy": ScoreColumn("mean over classes", "%", "accuracy", "accuracy"),
    }
    main_score: ClassVar[str] = "accuracy"
    takes: ClassVar[str] = "views of shapes (B, N, C, h, w) to logits of classes (B, K)"

    def __init__(self, class_names: Sequence[str], label_smoothing: float = 0.0) -> None:
        super().__init__(class_names)
        self.num_outputs = len(self.class_names)
        self.label_smoothing = label_smoothing

    def loss_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        """Return the cross-entropy, summed over the shapes."""
        exact = outputs.to(torch.promote_types(outputs.dtype, torch.float32))
        smoothing = self.label_smoothing
        return functional.cross_entropy(exact, targets, reduction="sum", label_smoothing=smoothing)

    def loss_norm(self, targets: Tensor) -> Tensor:
        """Return the number of shapes."""
        return torch.full((), float(len(targets)), device=targets.device)

    def build_metric(self) -> ClassificationMetric:
        """Build the confusion matrix of whole shapes."""
        return ClassificationMetric(len(self.class_names))

    def scores(self, result: Any) -> Scores:
        """Return the accuracy over shapes, its mean over classes, and that of every class."""
        found = classification_scores(result)
        means = {"accuracy": found.accuracy, "class_accuracy": found.class_accuracy}
        return Scores(means, {"images": found.counts, "accuracy": found.of_class}, confusion=result)
