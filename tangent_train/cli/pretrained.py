"""Take the network and its tensors from another file for a training, ``init_from``."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
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
from tangent_train.cli.settings import Trust, parse_settings
from tangent_train.config.build import SettingsFile, build_from_config
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, printable

_RGB = 3
_TYPED = re.compile(r"[+~]*network[.@=]")


def with_pretrained_network(
    path: Path, settings: Mapping[str, Any]
) -> tuple[Mapping[str, Any], SettingsFile | None]:
    """Return the settings of a run with the network and the normalization of a file.

    The network of the config stays if the user typed one (``network=…``, ``network.widths=…``), or
    if it wraps a network of the file's class, e.g. in `SphereContext`. Classes and channels are
    those of the data. The normalization of the config stays if it is not null.

    Args:
        path: File of a kind that `initialize` reads. Nothing changes if it does not describe its
            network, such as a state dict, or if the config has no group ``network``, such as the
            complete config of a stage of a transfer.
        settings: Settings of the run.

    Returns:
        Settings of the run, and the file that some come from, or None.

    Raises:
        DataError: It is an ONNX file, or its network does not return scores that can be trained.
    """
    if path.suffix.lower() == ".onnx":
        raise DataError(
            path,
            found="an ONNX file, whose tensors cannot be trained",
            expected="a checkpoint, a state dict or a .safetensors file",
            remedy="Use the checkpoint that it was exported from.",
        )
    description, hydra = read_description(path), HydraConfig.get()
    if description is None or "network" not in hydra.runtime.choices:
        return settings, None
    changed, source, notes = dict(settings), None, []
    network = changed["network"]
    section = description.trainable_settings() or {}
    target = section.get("_target_")
    if any(map(_TYPED.match, hydra.overrides.task)) or _wraps(network, target):
        notes.append(f"Network of the config: {network['_target_']}")
    else:
        if description.score_kind in ("probabilities", "labels"):
            raise DataError(
                path,
                found=f"a network that returns {description.score_kind}",
                expected="scores before a softmax or sigmoid, which the losses need",
                remedy="Remove the last step of the network, and import it again.",
            )
        changed["network"] = section
        trust = parse_settings(Trust, settings).trust
        source = SettingsFile(path, trust, settings.keys() - {"network"})
        notes.append(f"Network of {path}: {target} (another: network=…)")
    head = changed["task"]["head"]
    if description.depth_kind is not None and "depth_kind" in head:
        kind = head["depth_kind"] or description.depth_kind
        changed["task"] = changed["task"] | {"head": head | {"depth_kind": kind}}
        notes.append(f"Output of the network: {kind} (another: task.head.depth_kind=…)")
    normalization = _normalization(description, changed["data"])
    if normalization is not None:
        changed["data"] = changed["data"] | {"normalization": normalization}
        mean, std = (" ".join(f"{value:.4g}" for value in v) for v in normalization.values())
        notes.append(
            f"Normalization of {path}: mean {mean}, std {std} (another: data.normalization=…)"
        )
    _print("\n".join(notes))
    return changed, source


def load_pretrained(path: Path | None, run: Run) -> None:
    """Load the tensors of a file into the network of a new run, and print their names.

    Args:
        path: File with tensors; None to train from scratch.
        run: Run whose network is changed in place, and whose task gets the names of new tensors.

    Raises:
        DataError: The file cannot be read, or none of its tensors fit.
        SettingError: A learning rate is set for a backbone, but no file is given.
    """
    if path is None:
        if run.task.backbone_lr_factor != 1:
            raise SettingError(
                "task.backbone_lr_factor",
                found=run.task.backbone_lr_factor,
                expected="1 without init_from=: the backbone is the part that is loaded",
            )
        return
    description, network = read_description(path), run.task.network
    channels = None
    of_other_classes: Collection[str] = ()
    if description is not None:
        names = tuple(run.data.class_names)
        if description.groups is not None or description.class_names != names:
            of_other_classes = _heads(run)
        inputs = getattr(run.data, "inputs", None)
        if description.inputs and inputs is not None:
            channels = (channel_names(description.inputs), channel_names(inputs))
    origins = initialize(network, path, channels, of_other_classes)
    run.task.fresh = frozenset(origins.fresh)
    _print(f"Tensors from {path}\n{origins}")


@rank_zero_only
def _print(text: str) -> None:
    print_text(printable(text))


def _wraps(section: Mapping[str, Any], target: Any) -> bool:
    """Return True if the settings of a network contain those of a network of this class."""
    inner = [value for value in section.values() if isinstance(value, Mapping)]
    return any(value.get("_target_") == target or _wraps(value, target) for value in inner)


def _normalization(
    description: NetworkDescription, data: Mapping[str, Any]
) -> dict[str, list[float]] | None:
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
    section, data = run.settings["network"], run.data
    outputs = run.task.head.num_outputs
    more = completed_settings(section, data.in_channels, outputs + 1, restored=True)
    larger = build_from_config(more, "network", run.source).state_dict()
    tensors = run.task.network.state_dict()
    return {name for name, tensor in tensors.items() if tensor.shape != larger[name].shape}
