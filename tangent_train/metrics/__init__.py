"""Integer confusion matrices and the scores read from them."""

from tangent_train.metrics.segmentation import ConfusionMatrix, segmentation_scores

__all__ = ["ConfusionMatrix", "segmentation_scores"]
