"""A head outside the project: how sure a pixel is of one class, a number from 0 to 1."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import cv2
import numpy as np
from torch import Tensor
from torchmetrics import MeanAbsoluteError

from tangent_train.heads import Head, Scores
from tangent_train.metrics.scores import ScoreColumn
from tangent_train.rendering.mosaic import MeanMosaic


class ShareMosaic(MeanMosaic):
    """The mean of all views."""

    facts: ClassVar[dict[str, Any]] = {}

    def pixels(self) -> Tensor:
        return self.values()[0]


class ShareHead(Head):
    """Regresses 1 for the pixels of a class and 0 for others."""

    kind = "share"
    labels = "pixel_classes"
    columns: ClassVar = {"mae": ScoreColumn("mean absolute error", "", better="lower")}
    main_score = "mae"
    num_outputs = 1

    def __init__(self, class_names: Sequence[str], class_name: str) -> None:
        super().__init__(class_names)
        self.label = self.class_names.index(class_name)

    def truth(self, labels: Tensor) -> Tensor:
        return (labels == self.label).float()

    def loss_sum(self, outputs: Tensor, targets: Tensor) -> Tensor:
        return (outputs[:, 0].sigmoid() - targets).square().sum()

    def loss_norm(self, targets: Tensor) -> Tensor:
        return targets.new_tensor(float(targets.numel()))

    def build_metric(self) -> MeanAbsoluteError:
        return MeanAbsoluteError()

    def scores(self, result: Any) -> Scores:
        return Scores({"mae": float(result)})

    def mosaic(self, shape: Any, blend: Any, *, device: Any = "cpu", **_: Any) -> ShareMosaic:
        return ShareMosaic(shape, blend, device=device)

    def comparable(self, prediction: Tensor, truth: Tensor, ray_lengths: Any = None) -> Tensor:
        return prediction.sigmoid()

    def panel(self, rgb: Any, truth: Any, prediction: Any) -> Any:
        text = f"{truth.mean():.3f} {prediction.mean():.3f}"
        return cv2.putText(np.ascontiguousarray(rgb), text, (2, 12), 0, 0.4, (255, 0, 0))
