"""Output heads: how a kind of output is trained, scored, put together, drawn and written."""

from __future__ import annotations

from typing import Any

from tangent_train.heads.base import Head, Heading, PredictedImage, Scores
from tangent_train.heads.classes import ClassesHead
from tangent_train.heads.distance import DistanceHead
from tangent_train.heads.image_class import ImageClassHead

__all__ = [
    "ClassesHead",
    "DistanceHead",
    "Head",
    "Heading",
    "ImageClassHead",
    "PredictedImage",
    "Scores",
    "head_of",
]


def head_of(loaded: Any, **settings: Any) -> ClassesHead | DistanceHead:
    """Return the head of a network from a file.

    Args:
        loaded: `TrainedNetwork`.
        **settings: Settings of the head, see `Head.predict_settings`.
    """
    if loaded.depth_kind is not None:
        return DistanceHead(depth_kind=loaded.depth_kind, **settings)
    head = ClassesHead(loaded.class_names, **settings)
    head.num_outputs = loaded.network.num_scores  # with that of no class
    return head
