"""Tasks: loss, metrics and optimization of a network, which is an argument."""

from tangent_train.tasks.classification import ClassificationTask
from tangent_train.tasks.depth import DepthTask
from tangent_train.tasks.schedules import warmup_cosine
from tangent_train.tasks.segmentation import SegmentationTask

__all__ = ["ClassificationTask", "DepthTask", "SegmentationTask", "warmup_cosine"]
