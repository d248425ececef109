"""Data module and task of a config, checked before any data is generated."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import nn

from datamodules.core.split_module import SplitDataModule
from tangent_train.checkpoints.trained import TrainedNetwork, completed_settings
from tangent_train.cli.settings import parse_settings
from tangent_train.errors import SettingError, counted
from tangent_train.inference.class_maps import Unmapped, load_class_map, map_classes
from tangent_train.inference.views import check_size
from tangent_train.registry import SettingsFile, build_from_config, resolve_target

_RGB = 3

Settings = Mapping[str, Any]
"""All settings of a run, resolved: plain values in nested sections."""


def build(
    settings: Settings, source: SettingsFile | None = None, *, trains: bool = True
) -> tuple[Any, Any]:
    """The data module and the task of a run.

    Network settings that are null are taken from the data: ``in_channels``, and ``num_classes`` or
    ``classes``, also of a network inside the network's settings. Where a checkpoint will bring the
    tensors, no others are fetched first.

    Args:
        settings: Of the run.
        source: The file they come from, see `registry.build_from_config`.
        trains: False if the task is only evaluated: its optimizer and scheduler are not made.

    Returns:
        Data module and task.

    Raises:
        SettingError: A setting, or a combination of settings, is invalid.
    """
    data = build_data(settings, source)
    restored = settings.get("resume") is not None or settings.get("checkpoint") is not None
    section = completed_settings(
        settings["network"], data.in_channels, data.num_classes, restored=restored
    )
    network = build_from_config(section, "network", source)
    task = _build_task(settings, data, network, source, trains=trains)
    _try_network(task, data.in_channels)
    if not trains:
        return data, task
    synchronized = bool(settings["trainer"].get("sync_batchnorm"))
    probe = copy.deepcopy(task).to("meta")
    data.try_step = partial(_try_step, probe, data, synchronized)
    data.try_step(data.per_step)
    _try_schedule(task, settings)
    return data, task


def build_data(settings: Settings, source: SettingsFile | None = None) -> Any:
    """The data module of a run, with the labels that its task needs; see `build`."""
    representation = build_from_config(settings["representation"], "representation", source)
    data_set = resolve_target(settings["data"], "data", source)
    if isinstance(data_set, type) and not issubclass(data_set, SplitDataModule):
        expected = "labelled images or shapes; pairs are for tangent-keypoints"
        raise SettingError("data", found=data_set.__name__, expected=expected)
    data = build_from_config(settings["data"], "data", source, representation=representation)
    data.check_classes()
    task = resolve_target(settings["task"], "task", source)
    needed = getattr(task, "labels", data.labels)
    if needed != data.labels:
        raise SettingError(
            "task",
            found=f"{getattr(task, '__name__', task)}, which needs {needed}",
            expected=f"a task for {data.labels}, the labels of {type(data).__name__}",
        )
    return data


def build_trained(
    settings: Settings, trained: TrainedNetwork, source: SettingsFile | None = None
) -> tuple[Any, Any, list[str]]:
    """The data module and the task that evaluate a network from a file.

    Args:
        settings: Of the evaluation, perhaps with ``class_map`` and ``unmapped``.
        trained: The network.
        source: The file they come from, see `registry.build_from_config`.

    Returns:
        Data module, task, and what the class map was understood to say.

    Raises:
        SettingError: The network does not suit the data, or they do not suit the class map.
    """
    data = build_data(settings, source)
    notes = []
    if settings.get("class_map") is not None:
        given = parse_settings(_Mapping, settings)
        class_map = load_class_map(given.class_map)
        mapped = map_classes(trained, class_map, given.unmapped, data.class_names[1:])
        trained, notes = mapped.trained, [f"Class map {class_map.name}: {mapped}."]
    check_fits(data, shown(trained), settings["checkpoint"])
    check_size(trained, data.representation.image_size)
    task = _build_task(settings, data, trained.network, source, trains=False)
    return data, task, notes


@dataclass(frozen=True)
class _Mapping:
    """See ``configs/evaluate.yaml``."""

    class_map: str | Path
    unmapped: Unmapped


def check_fits(data: Any, network: Mapping[str, Any], name: object) -> None:
    """Refuse data of other inputs or classes than those of a network.

    Args:
        data: The data module.
        network: As `shown`, and perhaps more.
        name: Of the network, for the message.

    Raises:
        SettingError: They are others.
    """
    for what, value in shown(data).items():
        if network[what] != value:
            raise SettingError(
                f"data, for {name}",
                found=f"{what.replace('_', ' ')} {value}",
                expected=f"{network[what]}, which the network was trained with",
                remedy="class_map= says which are the same." if what == "class_names" else "",
            )


def shown(of: Any) -> dict[str, Any]:
    """Inputs and classes of a data module or a trained network, as plain values."""
    mean, std = list(of.normalization.mean), list(of.normalization.std)
    inputs = {"inputs": list(of.inputs)} if hasattr(of, "inputs") else {}
    names = list(of.class_names)
    return {"class_names": names, **inputs, "normalization": {"mean": mean, "std": std}}


def _build_task(
    settings: Settings, data: Any, network: nn.Module, source: SettingsFile | None, *, trains: bool
) -> Any:
    """The task of a run with its network; see `build`."""
    parts: dict[str, Any] = {"optimizer": _no_optimizer}
    if trains:
        optimizer = dict(settings["optimizer"])
        parts["backbone_lr_factor"] = optimizer.pop("backbone_lr_factor", 1.0)
        parts["optimizer"] = build_from_config(optimizer, "optimizer", source)
    if trains and settings.get("scheduler") is not None:
        parts["scheduler"] = build_from_config(settings["scheduler"], "scheduler", source)
    return build_from_config(
        settings["task"],
        "task",
        source,
        network=network,
        representation=data.representation,
        class_names=data.class_names,
        **parts,
    )


def _no_optimizer(*_: Any, **__: Any) -> Any:
    raise RuntimeError("a task that is only evaluated has no optimizer")


def _try_schedule(task: Any, settings: Settings) -> None:
    """Make the optimizer, and the scheduler for some number of steps; take one of them."""
    group = {"params": [torch.zeros(1, 1, requires_grad=True)]}

    def schedule() -> None:
        made = task.optimization(lambda: 1000)
        if isinstance(made, dict):
            made["optimizer"].step(lambda: 0.0)  # some optimizers need a closure
            made["lr_scheduler"]["scheduler"].step()

    trials: dict[str, Callable[[], object]] = {
        "optimizer": lambda: task.make_optimizer([group]),
        "scheduler": schedule,
    }
    for name, trial in trials.items():
        try:
            trial()
        except Exception as error:
            expected = f"settings that {settings[name]['_target_']} takes"
            raise SettingError(
                name, found=f"{type(error).__name__}: {error}", expected=expected
            ) from error


def _try_network(task: Any, channels: int) -> None:
    """Run the network on an empty input, to find mismatches before any data is generated."""
    shape = tuple(task.example(channels).shape)
    if fault := _fault(task, shape, trains=False):
        raise SettingError(
            "network",
            found=f"{type(task.network).__name__}, which does not take {shape} ({fault})",
            expected=f"one that maps {task.takes}",
            remedy="A network for photos takes data.inputs=[rgb]." if channels > _RGB else "",
        )


def _try_step(probe: Any, data: Any, synchronized: bool, samples: int) -> None:
    """Run the network in training mode on the smallest chunk of a training step.

    Batch normalization fails on a single value per channel, such as a single image of 1×1 features.

    Args:
        probe: The task, on the device ``meta``.
        data: The data module.
        synchronized: True if several processes normalize together.
        samples: Panoramas, photos or shapes of the step.

    Raises:
        SettingError: The network cannot be trained on it.
    """
    if synchronized and (data.trainer is None or data.trainer.world_size > 1):
        return
    step = probe.empty_step(data.in_channels, samples)
    chunk = min(probe.chunks(step), key=len)
    shape = tuple(chunk.shape)
    if fault := _fault(probe.network, shape, trains=True):
        per_step = f"data.{data.noun}_per_step"
        is_whole = len(chunk) == len(step)
        raise SettingError(
            per_step if is_whole else "task.images_per_chunk",
            found=f"{data.per_step if is_whole else probe.images_per_chunk}, so that in a step of "
            f"{counted(samples, data.noun)} {type(probe.network).__name__} gets {shape}, on which "
            f"it cannot be trained ({fault})",
            expected="more images at a time, in the last step of an epoch too",
            remedy=f"Change {per_step} or task.images_per_chunk, or choose a network without batch "
            "normalization.",
        )


def _fault(module: nn.Module, shape: tuple[int, ...], *, trains: bool) -> str | None:
    """The first line of the error of a module on empty images; None without an error.

    Nothing is computed where shapes are enough to know.
    """
    fault = None
    for device in ("meta", "cpu"):
        trial = copy.deepcopy(module).to_empty(device=device).train(trains)
        try:
            with torch.random.fork_rng(devices=[]), torch.no_grad():
                for tensor in (*trial.parameters(), *trial.buffers()):
                    tensor.zero_()  # memory may hold any numbers, and buffers are indices too
                trial.forward(torch.zeros(shape, device=device))  # a compiled one is not compiled
        except SettingError:
            raise
        except (RuntimeError, ValueError) as error:
            fault = str(error).partition("\n")[0]
        else:
            return None
    return fault
