"""Confusion matrices of integer counts, and scores computed from them."""

from tangent_train.metrics.segmentation import SegmentationMetric, segmentation_scores

__all__ = ["SegmentationMetric", "segmentation_scores"]
