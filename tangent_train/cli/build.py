"""Data module and task of a config, checked before any data is made."""

from __future__ import annotations

import copy
import os
import shutil
import traceback
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch

from tangent_train.checkpoints.trained import completed_settings
from tangent_train.errors import SettingError
from tangent_train.registry import make, maker_of

__all__ = ["Settings", "build", "check_numbers"]

Settings = Mapping[str, Any]
"""All settings of a run, resolved: plain values in nested sections."""

_REMEDIES = {
    "classification": "Choose task=classification with a network for it (experiment=shapes/default "
    "has both), or data of panoramas or photos.",
    "segmentation": "Choose data of shapes, as data=synthshapes, or task=segmentation with a "
    "network for it.",
}
"""By what the data has labels for."""

_SOME_STEPS = 100  # to try a scheduler with
_ANY = 2**32
_WHOLE = {
    "level": (0, 13),  # 16384×32768 pixels, as large as files may be
    "seed": (0, _ANY - 1),
    "trainer.accumulate_grad_batches": (1, _ANY),
    "trainer.check_val_every_n_epoch": (1, _ANY),
    "trainer.max_epochs": (1, _ANY),
    "trainer.max_steps": (1, _ANY),
}
"""Settings that are whole numbers, least and most; null where that is allowed."""

_ENDLESS = ("trainer.max_epochs", "trainer.max_steps")
"""Those of them of which −1 means no end."""


def build(settings: Settings, trust: Collection[str] | None = None) -> tuple[Any, Any]:
    """The data module and the task of a run.

    Network settings that are null are taken from the data: ``in_channels``, and ``num_classes`` or
    ``classes``, also of a network inside the network's settings. Where a checkpoint will bring the
    tensors, no others are fetched first.

    Args:
        settings: Of the run.
        trust: Of settings that come from a file, see `registry.make`.

    Returns:
        Data module and task.

    Raises:
        SettingError: A setting cannot work, or two of them not together.
    """
    check_numbers(settings)
    _check_compiler(settings["task"].get("compile"))
    parts = {
        name: make(settings[name], name, trust)
        for name in ("representation", "optimizer", "scheduler")
        if settings.get(name) is not None
    }
    representation = parts["representation"]
    data = make(settings["data"], "data", trust, representation=representation)
    _check_kind(maker_of(settings["task"], "task", trust), data)
    restored = settings.get("resume") is not None or settings.get("checkpoint") is not None
    network = completed_settings(
        settings["network"], data.in_channels, len(data.class_names), restored=restored
    )
    parts["network"] = make(network, "network", trust)
    task = make(settings["task"], "task", trust, class_names=data.class_names, **parts)
    _try_network(task, data.in_channels)
    _try_optimizer(task, settings)
    return data, task


def check_numbers(settings: Settings) -> None:
    """Refuse numbers that would be found out late, or with many lines about something else.

    Args:
        settings: Of the run.

    Raises:
        SettingError: There is one.
    """
    for name, (least, most) in _WHOLE.items():
        value = _select(settings, name)
        if value is None or (value == -1 and name in _ENDLESS):
            continue
        if type(value) is not int or not least <= value <= most:
            expected = f"a whole number from {least}" + (f" to {most}" if most < _ANY else "")
            raise SettingError(name, found=value, expected=expected)
    clipped = _select(settings, "trainer.gradient_clip_val")
    if clipped is not None and not (type(clipped) in (int, float) and clipped >= 0):
        raise SettingError(
            "trainer.gradient_clip_val", found=clipped, expected="a number from 0, or null"
        )


def _select(settings: Settings, name: str) -> Any:
    value: Any = settings
    for part in name.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _check_kind(task: Any, data: Any) -> None:
    """Refuse a task that learns something else than the data has labels for."""
    labelled = getattr(data, "kind", "segmentation")
    kind = getattr(task, "kind", labelled)
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


def _try_optimizer(task: Any, settings: Settings) -> None:
    """Make optimizer and scheduler: nothing is computed, and a wrong number shows."""
    for name in ("optimizer", "scheduler"):
        try:
            if name == "optimizer":
                task.make_optimizer(task.parameters())
            else:
                task.optimization(lambda: _SOME_STEPS)
        except (AssertionError, TypeError, ValueError) as error:
            plain = {k: v for k, v in settings[name].items() if not str(k).startswith("_")}
            written = ", ".join(f"{name}.{key}={value}" for key, value in plain.items())
            raise SettingError(
                name,
                found=f"{written} ({error})",
                expected=f"settings that {settings[name]['_target_']} takes",
            ) from error


def _place(error: Exception) -> str:
    """Where it was raised: the last line that is not torch's."""
    frames = traceback.extract_tb(error.__traceback__)
    last = next(frame for frame in reversed(frames) if "/torch/" not in frame.filename)
    return f"{Path(last.filename).name}, line {last.lineno}"
