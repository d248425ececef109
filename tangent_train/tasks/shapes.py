"""Classification of shapes from all images of their spheres."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from tangent_train.tasks.base import Task


class ShapeTask(Task):
    """Trains a network that classifies a shape by all views of its sphere (paper, section 4.1).

    With `view_batch_size`, a step is computed in chunks of whole shapes. The network is a module
    ``(B, N, C, h, w) -> (B, K)`` that takes N views of each of B shapes; the arguments are those of
    `Task`.
    """

    def forward(
        self, images: Float[Tensor, "shapes views channels height width"]
    ) -> Float[Tensor, "shapes classes"]:
        """Return the logits of the classes."""
        logits: Tensor = self.network(images)
        return logits

    def example(self, channels: int) -> Tensor:
        """Return all views of one empty shape ``(1, N, C, h, w)``."""
        grid = getattr(self.representation, "grid", None)  # an equirectangular image is one view
        views = 1 if grid is None else grid.num_images
        return torch.zeros(1, views, channels, *self.representation.image_size)

    def training_pairs(self, batch: Any) -> tuple[Tensor, Tensor]:
        """Return the views ``(B, N, C, h, w)`` and classes ``(B,)`` of shapes."""
        return batch.images, batch.label

    def evaluate(self, batch: Any) -> Tensor:
        """Add a batch of shapes to `metric`; return the predictions ``(B,)``."""
        logits = self(batch.images)
        if not self.is_tested:
            self.add_validation_loss(logits, batch.label)
        prediction = logits.argmax(dim=1)
        self.metric.update(prediction, batch.label)
        return prediction

    def true_labels(self, batch: Any) -> Tensor:
        """Return the true classes ``(B,)``."""
        labels: Tensor = batch.label
        return labels
