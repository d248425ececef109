"""Data module and task of a config, checked before any data is made."""

from __future__ import annotations

import copy
import os
import shutil
import traceback
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, OmegaConf

from tangent_train.errors import SettingError
from tangent_train.tasks.networks import completed_settings, make

__all__ = ["build"]

_REMEDIES = {
    "classification": "Choose task=classification with a network for it (experiment=shapes/default "
    "has both), or data of panoramas or photos.",
    "segmentation": "Choose data of shapes, as data=synthshapes, or task=segmentation with a "
    "network for it.",
}
"""By what the data has labels for."""


def build(config: DictConfig) -> tuple[Any, Any]:
    """The data module and the task of a config.

    Network settings that are null are taken from the data: ``in_channels``, and ``num_classes`` or
    ``classes``, also of a network inside the network's settings. Where a checkpoint will bring the
    tensors, no others are fetched first.

    Args:
        config: A composed config.

    Returns:
        Data module and task.

    Raises:
        SettingError: A setting cannot work, or two of them not together.
    """
    _check_compiler(config.task.get("compile"))
    representation = instantiate(config.representation)
    data = instantiate(config.data, representation=representation)
    _check_kind(config.task, data)
    restored = config.get("resume") is not None or config.get("checkpoint") is not None
    network = OmegaConf.to_container(config.network, resolve=True)
    classes = len(data.class_names)
    task = instantiate(
        config.task,
        network=make(completed_settings(network, data.in_channels, classes, restored=restored)),
        representation=representation,
        class_names=data.class_names,
        optimizer=instantiate(config.optimizer),
        scheduler=instantiate(config.scheduler),
    )
    _try_network(task, data.in_channels)
    return data, task


def _check_kind(settings: DictConfig, data: Any) -> None:
    """Refuse a task that learns something else than the data has labels for."""
    labelled = getattr(data, "kind", "segmentation")
    kind = getattr(get_object(settings._target_), "kind", labelled)
    if kind != labelled:
        raise SettingError(
            "task",
            found=f"{kind}, with the {data.noun} of {type(data).__name__}",
            expected=labelled,
            remedy=_REMEDIES[labelled],
        )


def _check_compiler(compiling: Any) -> None:
    """`torch.compile` writes C++; without a compiler it says so in 170 lines, after the data."""
    if compiling is None or compiling.get("backend", "inductor") != "inductor":
        return
    compilers = (os.environ.get("CXX", "g++"), "clang++")
    if not any(map(shutil.which, compilers)):
        raise SettingError(
            "task.compile",
            found=f"no C++ compiler ({' or '.join(compilers)})",
            expected="one, for torch.compile",
            remedy="Install one (g++), name it in CXX, or set task.compile=null.",
        )


def _try_network(task: Any, channels: int) -> None:
    """Run the network on an empty input: what does not fit shows before any data is made."""
    images = task.example(channels)
    probe = copy.deepcopy(task).to("meta").eval()  # shapes only: nothing is computed
    with torch.no_grad():
        try:
            try:
                probe(images.to("meta"))
            except NotImplementedError:  # by an operation that only computes
                probe = copy.deepcopy(task).eval()
                probe(images)
        except RuntimeError as error:
            first_line = str(error).partition("\n")[0]
            raise SettingError(
                "network",
                found=f"{type(task.network).__name__}, which does not take {tuple(images.shape)} "
                f"({_place(error)}: {first_line})",
                expected=f"one that maps {task.takes}",
            ) from error


def _place(error: Exception) -> str:
    """Where it was raised: the last line that is not torch's."""
    frames = traceback.extract_tb(error.__traceback__)
    last = next(frame for frame in reversed(frames) if "/torch/" not in frame.filename)
    return f"{Path(last.filename).name}, line {last.lineno}"
