"""Tasks: loss, metrics and optimization. Networks are injected, never imported."""

from tangent_train.tasks.classification import ClassificationTask
from tangent_train.tasks.schedules import warmup_cosine
from tangent_train.tasks.segmentation import SegmentationTask

__all__ = ["ClassificationTask", "SegmentationTask", "warmup_cosine"]
