"""Take the network and its tensors from a file for a training, ``init_from``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.utilities import rank_zero_only

from datamodules.core.inputs import RGBD_NORMALIZATION, channel_names
from models import initialize
from tangent_train.checkpoints.loaded import (
    NetworkDescription,
    completed_settings,
    read_description,
)
from tangent_train.cli.run import Run
from tangent_train.config.build import build_from_config
from tangent_train.config.settings import TrainSettings, typed_names
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, printable


def with_pretrained_network(
    path: Path, settings: TrainSettings
) -> tuple[TrainSettings, Path | None]:
    """Return the settings of a run with the network and the normalization of a file.

    The network of the config stays if the user typed one (``network=…``, ``network.widths=…``).
    Classes and channels are those of the data. The normalization of the config stays if it is not
    null.

    Args:
        path: File of a kind that `initialize` reads. Nothing changes if it does not describe its
            network, such as a state dict.
        settings: Settings of the run.

    Returns:
        Settings of the run, and the file that the network comes from, or None.

    Raises:
        DataError: The file has no network that can be trained.
    """
    description = read_description(path)
    if description is None or description.settings is None:
        return settings, None
    changes: dict[str, Any] = {}
    is_typed = any(re.match(r"network([.@]|$)", name) for name in typed_names())
    if not is_typed:
        if description.score_kind != "logits":
            found = f"a network that returns {description.score_kind}"
            raise DataError(path, found=found, expected="logits, which the losses need")
        changes["network"] = section = description.trainable_settings() or {}
        _print(f"Network of {path}: {section['_target_']} (another: network=…)")
    head, kind = settings.task["head"], description.depth_kind
    if kind is not None and head.get("depth_kind", "") is None:
        changes["task"] = settings.task | {"head": head | {"depth_kind": kind}}
        _print(f"Output of the network: {kind} (another: task.head.depth_kind=…)")
    normalization = _normalization(description, settings.data)
    if normalization is not None:
        changes["data"] = settings.data | {"normalization": normalization}
        _print(f"Normalization of {path}: {normalization} (another: data.normalization=…)")
    return settings.model_copy(update=changes), None if is_typed else path


def load_pretrained(run: Run, path: Path | None) -> None:
    """Load the tensors of a file into the network of a new run, and print their names.

    Args:
        run: Run whose network is changed in place, and whose task gets the names of new tensors.
        path: File with tensors; None to train from scratch.

    Raises:
        DataError: The file cannot be read, or none of its tensors fit.
        SettingError: A learning rate is set for a backbone, but no file is given.
    """
    task, data = run.task, run.data
    if path is None:
        if task.backbone_lr_factor != 1:
            expected = "1 without init_from=: the backbone is the part that is loaded"
            found = task.backbone_lr_factor
            raise SettingError("task.backbone_lr_factor", found=found, expected=expected)
        return
    known, channels, heads = read_description(path), None, set[str]()
    if known and (known.groups is not None or known.class_names != tuple(data.class_names)):
        heads = _heads(run)
    if known and known.inputs and hasattr(data, "inputs"):
        channels = (channel_names(known.inputs), channel_names(data.inputs))
    origins = initialize(task.network, path, channels, heads)
    task.fresh = frozenset(origins.fresh)
    _print(f"Tensors from {path}\n{origins}")


@rank_zero_only
def _print(text: str) -> None:
    print_text(printable(text))


def _normalization(
    description: NetworkDescription, data: Mapping[str, Any]
) -> dict[str, Sequence[float]] | None:
    """Return a file's normalization for the inputs of the data; None to keep that of the data."""
    inputs = data.get("inputs")
    if not description.inputs or inputs is None or data.get("normalization") is not None:
        return None
    given, default, count = description.normalization, RGBD_NORMALIZATION, 3 + ("depth" in inputs)
    pairs = {"mean": (given.mean, default.mean), "std": (given.std, default.std)}
    return {n: [*values, *more[len(values) :]][:count] for n, (values, more) in pairs.items()}


def _heads(run: Run) -> set[str]:
    """Return the names of the tensors whose shape depends on the number of classes."""
    section, data = run.settings.network, run.data
    outputs = run.task.head.num_outputs
    more = completed_settings(section, data.in_channels, outputs + 1, restored=True)
    larger = build_from_config(more, "network").state_dict()
    tensors = run.task.network.state_dict()
    return {name for name, tensor in tensors.items() if tensor.shape != larger[name].shape}
