"""Tasks with heads, from settings of both."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from tangent_train.heads import ClassesHead, DistanceHead, Head
from tangent_train.tasks import PixelTask, Task


def build_head(head: type[Head], names: Sequence[str], settings: dict[str, Any]) -> Any:
    """Build a head from the settings that tasks do not take, which are removed."""
    given = settings.keys() - inspect.signature(Task).parameters.keys()
    return head(names, **{name: settings.pop(name) for name in given})


def segmentation_task(
    network: nn.Module,
    representation: Any,
    names: Sequence[str],
    *optimization: Any,
    **settings: Any,
) -> PixelTask:
    """Build a task of classes; settings of the head and of the task are mixed."""
    head = build_head(ClassesHead, names, settings)
    return PixelTask(network, representation, head, *(optimization or [None]), **settings)


def depth_task(
    network: nn.Module, representation: Any, *optimization: Any, **settings: Any
) -> PixelTask:
    """Build a task of distances; settings of the head and of the task are mixed."""
    head = build_head(DistanceHead, (), settings)
    return PixelTask(network, representation, head, *(optimization or [None]), **settings)


def predict_labels(task: PixelTask, *arguments: Any, **settings: Any) -> Tensor:
    """Return the labels of a panorama that validation and test would score."""
    with torch.no_grad():
        return task.predict_panorama(*arguments, **settings)
