"""What segmentation minimises: cross-entropy, and what may stand beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.tasks.losses import (
    AuxiliaryTarget,
    RegionLoss,
    auxiliary_sum,
    check_region_loss,
    cross_entropy_norm,
    cross_entropy_sum,
    region_norm,
    region_sum,
)

__all__ = ["SegmentationLoss"]


@dataclass(frozen=True)
class SegmentationLoss:
    """The terms of the loss, each a sum over images and the norm it is divided by.

    Attributes:
        label_smoothing: Share of the target of the cross-entropy spread over all classes.
        auxiliary_weight: Of the loss of the scores that a network returns as ``"aux"`` beside
            ``"out"`` while training.
        auxiliary_target: What those are compared with, see `losses.auxiliary_sum`.
        region_loss: What stands beside the cross-entropy, see `losses.region_sum`.
        region_weight: Its weight.

    Raises:
        SettingError: A setting that cannot work.
    """

    label_smoothing: float = 0.0
    auxiliary_weight: float = 0.4
    auxiliary_target: AuxiliaryTarget = "histogram"
    region_loss: RegionLoss | Literal["none"] = "none"
    region_weight: float = 1.0

    def __post_init__(self) -> None:
        for name in ("auxiliary_weight", "region_weight"):
            if not getattr(self, name) >= 0:
                raise SettingError(f"task.{name}", found=getattr(self, name), expected="0 or more")
        if self.auxiliary_target not in get_args(AuxiliaryTarget):
            raise SettingError(
                "task.auxiliary_target",
                found=self.auxiliary_target,
                expected=" or ".join(get_args(AuxiliaryTarget)),
            )
        check_region_loss(self.region_loss)

    def sums(self, outputs: Mapping[str, Tensor], labels: Tensor, class_weights: Tensor) -> Tensor:
        """The terms of some images.

        Args:
            outputs: Scores ``(n, K + 1, h, w)`` under ``"out"``; perhaps ``"aux"`` of any
                resolution.
            labels: ``(n, h, w)`` class indices; 0 is unknown.
            class_weights: ``(K + 1,)``.

        Returns:
            ``(2,)`` float32: of the pixels, and of the regions.
        """
        scores = outputs["out"]
        pixels = cross_entropy_sum(scores, labels, class_weights, self.label_smoothing)
        if "aux" in outputs:
            auxiliary = auxiliary_sum(outputs["aux"], labels, class_weights, self.auxiliary_target)
            pixels = pixels + self.auxiliary_weight * auxiliary
        if self.region_loss == "none":
            return torch.stack([pixels, torch.zeros_like(pixels)])
        regions = region_sum(scores, labels, self.region_loss)
        return torch.stack([pixels, self.region_weight * regions])

    def norms(self, labels: Tensor, class_weights: Tensor) -> Tensor:
        """What the terms of all images are divided by, ``(2,)``.

        Args:
            labels: ``(n, h, w)`` of all.
            class_weights: ``(K + 1,)``.
        """
        pixels = cross_entropy_norm(labels, class_weights)
        regions = torch.ones_like(pixels) if self.region_loss == "none" else region_norm(labels)
        return torch.stack([pixels, regions])
