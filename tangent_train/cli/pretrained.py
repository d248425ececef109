"""Take the network and its tensors from a file for a training, ``init_from``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
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
from tangent_train.config.from_file import without_weights
from tangent_train.config.settings import TrainSettings
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, printable

_RGB = 3


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
    if path.suffix.lower() == ".onnx":
        expected = "a checkpoint, a state dict or a .safetensors file"
        raise DataError(path, found="an ONNX file, which is not trained", expected=expected)
    description = read_description(path)
    if description is None or description.settings is None:
        return settings, None
    changes: dict[str, Any] = {}
    typed = any(re.match(r"[+~]*network[.@=]", o) for o in HydraConfig.get().overrides.task)
    if not typed:
        if description.score_kind in ("probabilities", "labels"):
            raise DataError(
                path,
                found=f"a network that returns {description.score_kind}",
                expected="logits, which the losses need",
            )
        changes["network"] = section = without_weights(description.trainable_settings())
        _print(f"Network of {path}: {section['_target_']} (another: network=…)")
    head = settings.task["head"]
    if description.depth_kind is not None and head.get("depth_kind", "") is None:
        changes["task"] = settings.task | {"head": head | {"depth_kind": description.depth_kind}}
        kind = description.depth_kind
        _print(f"Output of the network: {kind} (another: task.head.depth_kind=…)")
    normalization = _normalization(description, settings.data)
    if normalization is not None:
        changes["data"] = settings.data | {"normalization": normalization}
        _print(f"Normalization of {path}: {normalization} (another: data.normalization=…)")
    return settings.model_copy(update=changes), None if typed else path


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
    description, channels, heads = read_description(path), None, set[str]()
    if description is not None:
        if description.groups is not None or description.class_names != tuple(data.class_names):
            heads = _heads(run)
        if description.inputs and hasattr(data, "inputs"):
            channels = (channel_names(description.inputs), channel_names(data.inputs))
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
    default = {"mean": RGBD_NORMALIZATION.mean, "std": RGBD_NORMALIZATION.std}
    count = _RGB + ("depth" in inputs)
    return {
        name: [*values, *default[name][len(values) :]][:count]
        for name, values in ((name, getattr(description.normalization, name)) for name in default)
    }


def _heads(run: Run) -> set[str]:
    """Return the names of the tensors whose shape depends on the number of classes."""
    section, data = run.settings.network, run.data
    outputs = run.task.head.num_outputs
    more = completed_settings(section, data.in_channels, outputs + 1, restored=True)
    larger = build_from_config(more, "network").state_dict()
    tensors = run.task.network.state_dict()
    return {name for name, tensor in tensors.items() if tensor.shape != larger[name].shape}
