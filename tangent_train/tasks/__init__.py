"""Tasks: what is learned, how it is scored and shown. Networks are injected, never imported."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tangent_train.tasks.metrics import ConfusionMatrix, SegmentationScores, segmentation_scores
    from tangent_train.tasks.segmentation import SegmentationTask

__all__ = ["ConfusionMatrix", "SegmentationScores", "SegmentationTask", "segmentation_scores"]


def __getattr__(name: str) -> Any:
    # On demand: reports need neither torch nor lightning.
    if name in __all__:
        module = "segmentation" if name == "SegmentationTask" else "metrics"
        return getattr(import_module(f"tangent_train.tasks.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
