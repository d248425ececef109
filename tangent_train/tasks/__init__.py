"""Tasks: what is learned, how it is scored and shown. Networks are injected, never imported."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tangent_train.tasks.classification import ClassificationTask
    from tangent_train.tasks.classification_metrics import (
        ClassificationScores,
        classification_scores,
    )
    from tangent_train.tasks.metrics import ConfusionMatrix, SegmentationScores, segmentation_scores
    from tangent_train.tasks.schedules import WarmupCosineLR
    from tangent_train.tasks.segmentation import SegmentationTask

__all__ = [
    "ClassificationScores",
    "ClassificationTask",
    "ConfusionMatrix",
    "SegmentationScores",
    "SegmentationTask",
    "WarmupCosineLR",
    "classification_scores",
    "segmentation_scores",
]

_MODULES = {
    "ClassificationTask": "classification",
    "SegmentationTask": "segmentation",
    "WarmupCosineLR": "schedules",
    "ClassificationScores": "classification_metrics",
    "classification_scores": "classification_metrics",
}
"""Where a name is, if not in `metrics`."""


def __getattr__(name: str) -> Any:
    # On demand: reports need neither torch nor lightning.
    if name in __all__:
        module = import_module(f"tangent_train.tasks.{_MODULES.get(name, 'metrics')}")
        return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
