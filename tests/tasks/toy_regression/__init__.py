"""A task outside the project: how much of a panorama is of one class, a number from 0 to 1."""

from __future__ import annotations

from typing import Any, ClassVar

import cv2
import numpy as np
import torch
from torch import Tensor
from torchmetrics import MeanAbsoluteError

from tangent_train.metrics.score_columns import ScoreColumn
from tangent_train.tasks.base import Task


class ShareOfClass(Task):
    """Regresses the share of the pixels of a class, with any network for segmentation."""

    monitor = "val/mae"
    takes = "images (n, C, h, w) to numbers (n, 1, h, w)"
    columns: ClassVar = {"mae": ScoreColumn("mean absolute error", "", better="lower")}

    def __init__(self, *arguments: Any, class_name: str, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        self.label = self.class_names.index(class_name)

    @staticmethod
    def num_outputs(num_classes: int) -> int:
        return 1

    def forward(self, images: Tensor) -> Tensor:
        return self.network(images).mean(dim=(1, 2, 3)).sigmoid()

    def share(self, labels: Tensor) -> Tensor:
        return (labels == self.label).float().mean(dim=(-2, -1))

    def example(self, channels: int) -> Tensor:
        return torch.zeros(1, channels, *self.representation.image_size)

    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        return batch.images.flatten(0, 1), self.share(batch.labels.flatten(0, 1))

    def loss_sum(self, inputs: tuple[Tensor, ...], labels: Tensor) -> Tensor:
        return (self(*inputs) - labels).square().sum()

    def loss_norm(self, labels: Tensor) -> Tensor:
        return labels.new_tensor(float(len(labels)))

    def targets(self, batch: Any) -> Tensor:
        return self.share(batch.target)

    def evaluate(self, batch: Any) -> Tensor:
        predictions = torch.stack([self(images).mean() for images in batch.images])
        self.metric.update(predictions, self.targets(batch))
        return predictions

    def build_metric(self) -> MeanAbsoluteError:
        return MeanAbsoluteError()

    def logged_scores(self, result: Any) -> dict[str, float]:
        return {"mae": float(result)}

    def picture(self, image: Any, target: Tensor, prediction: Tensor, *_: Any, **__: Any) -> Any:
        text = f"{float(target):.3f} {float(prediction):.3f}"
        return cv2.putText(np.ascontiguousarray(image.rgb), text, (2, 12), 0, 0.4, (255, 0, 0))
