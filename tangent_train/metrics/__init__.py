"""Integer confusion matrices and the scores read from them."""

from tangent_train.metrics.classification import ClassificationScores, classification_scores
from tangent_train.metrics.segmentation import (
    ConfusionMatrix,
    SegmentationScores,
    segmentation_scores,
)

__all__ = [
    "ClassificationScores",
    "ConfusionMatrix",
    "SegmentationScores",
    "classification_scores",
    "segmentation_scores",
]
