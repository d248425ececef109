"""Confusion matrices of integer counts, and scores computed from them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tangent_train.imports import on_first_use

if TYPE_CHECKING:
    from tangent_train.metrics.collected import SegmentationMetric
    from tangent_train.metrics.segmentation import segmentation_scores

__all__ = ["SegmentationMetric", "segmentation_scores"]

__getattr__ = on_first_use(
    __name__, {"SegmentationMetric": "collected", "segmentation_scores": "segmentation"}
)
