"""Tasks: loss, metrics and optimization. Networks are injected, never imported."""

from tangent_train.tasks.classification import ClassificationTask
from tangent_train.tasks.segmentation import SegmentationTask

__all__ = ["ClassificationTask", "SegmentationTask"]
