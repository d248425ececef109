"""What is typed, with every file in place, and the settings that make it small behind it.

What a document says is never changed but for stand-ins: an ellipsis in a path is the folder that is
there, one alone and a few names are looked up in `STAND_INS`, absolute paths in `world.PLACES`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from tangent_train.cli.compose import config_folder
from tests.slow.documentation.markdown import Command
from tests.slow.documentation.world import (
    DEMO,
    PAPER_PAIRS,
    PLACES,
    RGB_CHECKPOINT,
    ROOM_FOLDERS,
    ROOMS,
    ROWS,
    RUNS,
    SHAPES,
    TIME,
)

STAND_INS = {
    "experiment": "rooms/demo",
    "checkpoint": f"runs/{RUNS[0]}/{TIME}/checkpoints/best.ckpt",
    "resume": f"runs/{RUNS[0]}/{TIME}",
    "input": "panoramas",
    "output": "made",
    "data.root": ROOM_FOLDERS[0],
}
"""Values for settings that a document leaves open: ``…`` or ``<what it is>``."""

_ELLIPSIS = "…"
_OPEN = re.compile(r"…|<[^<>]*>")
_OF_A_UNET = {"_target_", "in_channels", "num_classes", "widths"}

_SMALL: dict[str, dict[str, Any]] = {
    "data": {
        "panoramas_per_step": 2,
        "photos_per_step": 2,
        "shapes_per_step": 4,
        "num_workers": 0,
        "validation_fraction": DEMO["data.validation_fraction"],
        "frames": 2,
        "panorama_height": ROWS,
    },
    "representation": {
        "erp_height": ROWS,
        "crop_multiple": "null",
        "faces_per_panorama": 2,
        "crop_deg": 180,
    },
    "trainer": {"num_nodes": 1},
}
"""Values for settings that are not null, if a config has them."""

_ALSO_NULL = {"erp_height"}
_OF_PAIRS = {"data.rooms.height", "data.rooms.supersample"}


class NoStandInError(LookupError):
    """A document's command names something that is not in `STAND_INS` or the world."""


def stand_in(command: Command, folder: Path) -> list[str]:
    """The words of a command with real files for placeholders.

    Raises:
        NoStandInError: There is none.
    """
    words = [word for word in command.words if word != _ELLIPSIS]
    return [_real(word, command, folder) for word in words]


def _real(word: str, command: Command, folder: Path) -> str:
    name, equals, value = word.rpartition("=")
    if word == "checkpoint=…" and _without_depth(command):
        return f"checkpoint={RGB_CHECKPOINT}"
    if _OPEN.fullmatch(value):
        if name.lstrip("+") not in STAND_INS:
            raise NoStandInError(f"{command}: no stand-in for {word}")
        return f"{name}={STAND_INS[name.lstrip('+')]}"
    for place, here in PLACES.items():
        if value == place or value.startswith(f"{place}/"):
            value = str(folder / (here + value.removeprefix(place)))
    if _OPEN.search(value):
        # An ellipsis between slashes may be several folders.
        parts = ("**" if _OPEN.fullmatch(p) else _OPEN.sub("*", p) for p in value.split("/"))
        found = sorted(folder.glob("/".join(parts)))
        if not found:
            raise NoStandInError(f"{command}: nothing at {value} in the world")
        value = str(found[0].relative_to(folder))
    if value.startswith("/") and not value.startswith(str(folder)):
        raise NoStandInError(f"{command}: no stand-in for {word}")
    return f"{name}{equals}{value}"


def _without_depth(command: Command) -> bool:
    """Whether the images that it labels have none, so that the network cannot want any."""
    return command.program == "tangent-predict" and not any(
        word.startswith("depth=") for word in command.words
    )


def small_settings(words: Sequence[str], folder: Path) -> list[str]:
    """What is appended to a command so that it takes seconds.

    Args:
        words: From `stand_in`.
        folder: That it runs in.

    Raises:
        NoStandInError: There is no rule for the program.
    """
    program, *arguments = words
    if "--help" in arguments:
        return []
    rule = _RULES.get(program)
    if rule is None:
        raise NoStandInError(f"{' '.join(words)}: no rule that makes {program} small")
    return rule(arguments, folder)


def _nothing(_arguments: Sequence[str], _folder: Path) -> list[str]:
    return []


def _benchmark(arguments: Sequence[str], _folder: Path) -> list[str]:
    """Benchmarks and studies take a while, and have tests of their own."""
    slow = arguments[0] == "-m" and arguments[1].startswith(("benchmarks", "studies"))
    return ["--help"] if slow else []


def _run(arguments: Sequence[str], folder: Path) -> list[str]:
    if any(text.startswith("resume=") for text in arguments):
        return []  # as it was begun
    return _overrides(_of_run("train", arguments, folder) | _of_sweep(arguments))


def _preparation(arguments: Sequence[str], folder: Path) -> list[str]:
    return _overrides(_of_run("prepare", arguments, folder))


def _transfer(arguments: Sequence[str], folder: Path) -> list[str]:
    config = _composed("transfer", arguments, folder)
    settings = _of_run("transfer", arguments, folder) | {
        "compare": "[]",
        "fine_tuning.epochs": "[]",
        "photos.representation.dim": 16,
        "photos.data.photos_per_step": 2,
        "photos.data.num_workers": 0,
        "study_max_rows": ROWS,
        "seeds": "[0]",
    }
    settings |= {"study_levels": "[4,5]"} if any(a.startswith("study=") for a in arguments) else {}
    settings |= {} if config.folds is None else {"folds": "[1]"}
    settings |= {"data.rooms.views_per_camera": 1} if "rooms" in config.data else {}
    return _overrides(settings)


def _evaluation(arguments: Sequence[str], _folder: Path) -> list[str]:
    rooms = any(text.startswith("data=synthrooms") for text in arguments)
    rows = any(text.startswith("representation.erp_height=") for text in arguments)
    height = {"representation.erp_height": ROWS} if rows else {}
    return _overrides({**(ROOMS if rooms else {}), **height})


def _keypoints(arguments: Sequence[str], _folder: Path) -> list[str]:
    """Two small rooms, or two small panoramas with the names of the paper's."""
    if "data=stanford2d3ds_pairs" in arguments:
        return [f"data.root={PAPER_PAIRS}", "max_pairs=2", "base_level=0"]
    if any(text.startswith(("left=", "input=")) for text in arguments):
        return []
    rooms = {name: value for name, value in ROOMS.items() if name in _OF_PAIRS}
    return _overrides({**rooms, "data.rooms.rooms.area_1": 1, "base_level": 0})


_RULES: Mapping[str, Callable[[Sequence[str], Path], list[str]]] = {
    "python": _benchmark,
    "tangent-check": _preparation,
    "tangent-evaluate": _evaluation,
    "tangent-export": _nothing,
    "tangent-keypoints": _keypoints,
    "tangent-predict": _nothing,
    "tangent-prepare": _preparation,
    "tangent-render": _nothing,
    "tangent-report": _nothing,
    "tangent-train": _run,
    "tangent-transfer": _transfer,
}


def _composed(name: str, arguments: Sequence[str], folder: Path, *more: str) -> DictConfig:
    """The config with the options of groups that are typed; of several the first."""
    configs = [config_folder()]
    if "--config-dir" in arguments:
        configs.append(folder / arguments[arguments.index("--config-dir") + 1])
    chosen = []
    for text in arguments:
        group, equals, options = text.partition("=")
        file = f"{group.partition('@')[0]}/{options.partition(',')[0]}.yaml"
        if equals and any((place / file).is_file() for place in configs):
            chosen.append(f"{group}={options.partition(',')[0]}")
    chosen = [c for c in chosen if not c.startswith(("sweep=", "launcher="))]
    search = ",".join(f"'file://{place}'" for place in configs[1:])
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        return compose(name, [*chosen, *more, f"hydra.searchpath=[{search}]"])


def _of_run(name: str, arguments: Sequence[str], folder: Path) -> dict[str, Any]:
    """Images of 16 pixels of two panoramas at a time, one epoch, a network of two layers."""
    config = _composed(name, arguments, folder)
    composed = partial(_composed, name, arguments, folder)
    of_network = _of_network(config, composed)
    level = DEMO["level"] if of_network else 5  # networks of their own take no less than 32 pixels
    settings: dict[str, Any] = {
        "level": level + (config.representation.get("base_level") or 0),
        "trainer.max_epochs": 1,
        "trainer.check_val_every_n_epoch": 1,
        "trainer.accelerator": "cpu",
        "trainer.devices": 1,
        "panels": 1,
    }
    settings |= ROOMS if "rooms" in config.data else {}
    if "shapes" in config.data:
        settings |= {name: value for name, value in SHAPES.items() if name.startswith("data.")}
    settings |= {
        f"{section}.{key}": value
        for section, known in _SMALL.items()
        for key, value in known.items()
        if config[section].get(key) is not None
        or key in _ALSO_NULL & set(config[section])
        or any(text.startswith(f"{section}.{key}=") for text in arguments)
    }
    if "task.compile={}" in arguments:
        settings["+task.compile.backend"] = "aot_eager"  # a C++ compiler takes half a minute
    return settings | of_network


def _of_network(config: DictConfig, composed: Callable[..., DictConfig]) -> dict[str, Any]:
    """The UNet's widths; a UNet in place of a ResNet, without what experiments say of that."""
    if "ShapeClassifier" in config.network._target_:
        return {"network.width": SHAPES["network.width"]}
    if "FCNResNet" not in config.network._target_:
        return {"network.widths": "[4,8]"} if "widths" in config.network else {}
    left = composed("network=unet").network
    others = {f"~network.{name}": None for name in left if name not in _OF_A_UNET}
    return {"network": "unet", "network.widths": "[4,8]"} | others


def _of_sweep(arguments: Sequence[str]) -> dict[str, Any]:
    settings: dict[str, Any] = {}
    if "sweep=optuna" in arguments:
        settings |= {"hydra.sweeper.n_trials": 1, "hydra.sweeper.n_jobs": 1}
    if "launcher=slurm" in arguments and "sweep=folds" in arguments:
        settings["hydra.sweeper.params"] = "{data.fold:1}"  # one job, in new interpreters
    return settings


def _overrides(settings: Mapping[str, Any]) -> list[str]:
    return [name if value is None else f"{name}={value}" for name, value in settings.items()]
