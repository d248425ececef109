"""Tasks: what is learned, how it is scored and shown. Networks are injected, never imported."""

from tangent_train.tasks.metrics import ConfusionMatrix, SegmentationScores, segmentation_scores
from tangent_train.tasks.segmentation import SegmentationTask

__all__ = ["ConfusionMatrix", "SegmentationScores", "SegmentationTask", "segmentation_scores"]
