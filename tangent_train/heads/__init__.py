"""Output heads: how a kind of output is trained, scored, put together, drawn and written."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from tangent_train.errors import SettingError, wrong_setting
from tangent_train.heads.base import Head, PredictedImage, Scores
from tangent_train.heads.classes import ClassesHead, ImageClassHead
from tangent_train.heads.distance import DistanceHead
from tangent_train.heads.panoptic import PanopticHead

__all__ = [
    "ClassesHead",
    "DistanceHead",
    "Head",
    "ImageClassHead",
    "PanopticHead",
    "PredictedImage",
    "Scores",
    "head_of",
]


def head_of(loaded: Any, **settings: Any) -> ClassesHead | DistanceHead:
    """Return the head of a network from a file.

    Args:
        loaded: `LoadedNetwork`.
        **settings: Settings of the head, see `Head.predict_settings`.

    Raises:
        SettingError: A setting is not one of that head, or invalid; or there are too many classes.
    """
    count = len(loaded.class_names) - 1
    if loaded.things and count > 255:  # panoptic maps have 8 bits for the label
        remedy = "Map them to fewer with label_map=."
        raise SettingError("classes", found=count, expected="at most 255", remedy=remedy)
    try:
        if loaded.depth_kind is not None:
            return DistanceHead(depth_kind=loaded.depth_kind, **settings)
        if loaded.things:
            head: ClassesHead = PanopticHead(loaded.class_names, loaded.things, **settings)
        else:
            head = ClassesHead(loaded.class_names, **settings)
    except ValidationError as error:
        raise wrong_setting(error) from error
    head.num_outputs = loaded.network.num_outputs  # with that of no class
    return head
