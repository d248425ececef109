"""Integer confusion matrices and the scores read from them."""

from tangent_train.metrics.segmentation import SegmentationMetric, segmentation_scores

__all__ = ["SegmentationMetric", "segmentation_scores"]
