"""Fine-tuning: what a run takes from the file that it starts from, ``init_from``."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.utilities import rank_zero_only

from datamodules.core.inputs import RGBD_NORMALIZATION, channel_names
from models import initialize
from tangent_train.checkpoints.trained import Start, completed_settings, start_in
from tangent_train.cli.build import Settings
from tangent_train.cli.evaluate import Run
from tangent_train.cli.settings import Trust, parse_settings
from tangent_train.console import print_text
from tangent_train.errors import DataError, printable
from tangent_train.registry import SettingsFile, build_from_config

_TYPED = re.compile(r"[+~]*network[.@=]")
_RGB = 3


def begin_from(path: Path, settings: Settings) -> tuple[Settings, SettingsFile | None]:
    """The settings of a run with the network and the normalization of the file it starts from.

    The network is the file's, unless the user typed one (``network=…``, ``network.widths=…``), or
    the composed one wraps a network of the file's class, as `SphereContext` does. The data decide
    its classes and channels. The normalization is the file's, unless the config has one.

    Args:
        path: Of any kind that `initialize` reads. A file that does not describe its network, such
            as a state dict, changes nothing; nor do configs without the group ``network``, such as
            the stages of a transfer, which are complete.
        settings: Of the run.

    Returns:
        Settings of the run, and the source of those that the file gave, if any.

    Raises:
        DataError: It is an ONNX file, or its network returns no scores that can be trained.
    """
    if path.suffix.lower() == ".onnx":
        raise DataError(
            path,
            found="an ONNX file, whose tensors cannot be trained",
            expected="a checkpoint, a state dict or a .safetensors file",
            remedy="Give the checkpoint that it was exported from.",
        )
    start, hydra = start_in(path), HydraConfig.get()
    if start is None or "network" not in hydra.runtime.choices:
        return settings, None
    changed, source, told = dict(settings), None, []
    network = changed["network"]
    target = start.settings.get("_target_")
    if any(map(_TYPED.match, hydra.overrides.task)) or _wraps(network, target):
        told.append(f"Network of the config: {network['_target_']}")
    else:
        if start.score_kind in ("probabilities", "sigmoid", "labels"):
            raise DataError(
                path,
                found=f"a network that returns {start.score_kind}",
                expected="scores before a softmax or sigmoid, which the losses need",
                remedy="Take the last step out of the network, and import it again.",
            )
        changed["network"] = start.settings
        source = SettingsFile(
            path, parse_settings(Trust, settings).trust, settings.keys() - {"network"}
        )
        told.append(f"Network of {path}: {target} (another: network=…)")
    normalization = _normalization(start, changed["data"])
    if normalization is not None:
        changed["data"] = changed["data"] | {"normalization": normalization}
        mean, std = (" ".join(f"{value:.4g}" for value in v) for v in normalization.values())
        told.append(
            f"Normalization of {path}: mean {mean}, std {std} (another: data.normalization=…)"
        )
    _print("\n".join(told))
    return changed, source


def load_start(path: Path, run: Run) -> None:
    """Load the tensors of the file that a run starts from, and print which.

    Args:
        path: The file.
        run: Its network is changed in place; its task learns which tensors are new.

    Raises:
        DataError: The file cannot be read, or nothing in it fits.
    """
    start, network = start_in(path), run.task.network
    channels = None
    others: Collection[str] = ()
    if start is not None:
        if start.groups is not None or start.class_names != tuple(run.data.class_names):
            others = _heads(run)
        inputs = getattr(run.data, "inputs", None)
        if start.inputs is not None and inputs is not None:
            channels = (channel_names(start.inputs), channel_names(inputs))
    origins = initialize(network, path, channels, others)
    run.task.fresh = frozenset(origins.fresh)
    _print(f"Tensors from {path}\n{origins}")


@rank_zero_only
def _print(text: str) -> None:
    print_text(printable(text))


def _wraps(section: Mapping[str, Any], target: Any) -> bool:
    """Whether a network of this class is inside another one, as their settings say."""
    inner = [value for value in section.values() if isinstance(value, Mapping)]
    return any(value.get("_target_") == target or _wraps(value, target) for value in inner)


def _normalization(start: Start, data: Mapping[str, Any]) -> dict[str, list[float]] | None:
    """The file's, of the inputs of the data; None where the data's own is right."""
    inputs = data.get("inputs")
    if start.inputs is None or inputs is None or data.get("normalization") is not None:
        return None
    default = {"mean": RGBD_NORMALIZATION.mean, "std": RGBD_NORMALIZATION.std}
    count = _RGB + ("depth" in inputs)
    return {
        name: [*values, *default[name][len(values) :]][:count]
        for name, values in ((name, start.normalization.get(name, ())) for name in default)
    }


def _heads(run: Run) -> set[str]:
    """Names of the tensors that grow with another class."""
    more = completed_settings(
        run.settings["network"], run.data.in_channels, run.data.num_classes + 1, restored=True
    )
    larger = build_from_config(more, "network", run.source).state_dict()
    own = run.task.network.state_dict()
    return {name for name, tensor in own.items() if tensor.shape != larger[name].shape}
