"""Take settings from a checkpoint, to resume a run or to evaluate a network.

Hydra composes the user's config with the options that the run was started with, as far as they are
options of this program. The settings in the file are plain data that never reach Hydra. They
replace the composed ones, except for typed settings and those of this machine.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from tangent_train.checkpoints.content import INPUTS, NORMALIZATION, read_checkpoint
from tangent_train.cli.command_settings import RunSettings
from tangent_train.cli.compose import path_text, quoted, values_of_sweep
from tangent_train.cli.remembered import remembered_settings
from tangent_train.cli.settings import Trust, names_of, parse_settings
from tangent_train.config.build import SettingsFile, Text, check_fields
from tangent_train.config.setting_rules import from_file
from tangent_train.errors import DataError, SettingError
from tangent_train.files import config_folder

_DECLARED = get_type_hints(RunSettings)
_SECTIONS = {
    name: dict | None if get_args(kind)[1:] == (NoneType,) else dict
    for name, kind in _DECLARED.items()
    if dict in (get_origin(kind), *map(get_origin, get_args(kind))) and from_file(name)
}
"""Sections that a checkpoint stores, with their kinds."""

_NEVER_STORED = ("callbacks", "debug", "logger")
"""Groups whose settings are not taken from a file: a resumed run composes their options again."""

GROUPS = ("experiment", "recipe", *_SECTIONS, *_NEVER_STORED)
"""Config groups whose chosen options a checkpoint stores as ``choices``."""

_RUN = {
    "choices": dict[str, Text] | None,
    "name": Text,
    **{name: kind for name, kind in _DECLARED.items() if name not in GROUPS},
}
"""Settings outside the sections, with their kinds."""

_NOT_EVALUATED = ("ema", "init_from", "optimizer", "resume", "scheduler")
"""Settings that an evaluation does not read."""

_EXPECTED = "the settings of a run"


@dataclass(frozen=True)
class StoredRun:
    """Settings of a run in a checkpoint, and the command line.

    Attributes:
        path: Checkpoint.
        config: Settings in the checkpoint, plain values.
        user_overrides: Arguments of the user, without the checkpoint.
        added: Overrides for the options, level and seed of the run.
        location_overrides: Overrides for the checkpoint and the run folder.
    """

    path: Path
    config: Mapping[str, Any]
    user_overrides: Sequence[str]
    added: Sequence[str]
    location_overrides: Sequence[str]

    @property
    def arguments(self) -> list[str]:
        """Command line for Hydra; the last override of a setting wins."""
        return [*self.added, *self.user_overrides, *self.location_overrides]

    def settings(self, composed: Mapping[str, Any]) -> tuple[dict[str, Any], SettingsFile]:
        """Return all settings of the continued run.

        Args:
            composed: Composed config, resolved.

        Returns:
            Settings, and the file that they come from.

        Raises:
            DataError: The file lacks settings.
            SettingError: A setting of this machine has to be typed.
        """
        typed = names_of(self.user_overrides)
        typed |= {"representation.level"} if "level" in typed else set()
        typed |= {"data.seed"} if "seed" in typed else set()
        of_run = check_fields(self.path, self.config, _RUN, _EXPECTED)
        of_run |= check_fields(self.path, self.config, _SECTIONS, _EXPECTED)
        settings = dict(composed)
        settings |= {name: value for name, value in of_run.items() if name not in typed}
        local: set[str] = set()
        for name in _SECTIONS.keys() - typed:
            if settings[name] is not None:
                settings[name], names = self._section(name, composed.get(name) or {}, typed)
                local |= names
        for name in typed:
            _copy_setting(settings, composed, name.split("."))
        if "data" in typed:
            settings["data"] |= self._network_settings(settings["data"], typed)
        trust = parse_settings(Trust, composed).trust
        return settings, SettingsFile(self.path, trust, typed | local)

    def _section(
        self, name: str, composed: Mapping[str, Any], typed: set[str]
    ) -> tuple[dict[str, Any], set[str]]:
        """Return a section of the file with the user's settings for this machine, and their names.

        Args:
            name: Name of the section.
            composed: The composed section.
            typed: Names of the settings that the user typed.
        """
        stored = self.config[name]
        names = {*stored, *composed}
        local = {n for n in names if not from_file(f"{name}.{n}", stored.get(n))}
        section = {n: v for n, v in stored.items() if n not in local}
        is_same_class = composed.get("_target_") == stored.get("_target_")
        of_user = {n: v for n, v in composed.items() if n in local and is_same_class}
        section |= of_user
        for n in sorted(local & {"root", "mask"} if name == "data" else ()):
            if f"data.{n}" not in typed and section.get(n) != stored.get(n):
                raise SettingError(
                    f"data.{n}",
                    found="null: paths are not taken from a checkpoint",
                    expected="the path of these files on this machine",
                    remedy=f"The run had data.{n}={stored.get(n)!r}: type that if right here.",
                )
        return section, {f"{name}.{n}" for n in of_user}

    def _network_settings(self, data: Mapping[str, Any], typed: set[str]) -> dict[str, Any]:
        """Return settings that belong to the network even with other data: test fold, inputs."""
        kinds = {"fold": int | None, "inputs": INPUTS | None, "normalization": NORMALIZATION | None}
        before = check_fields(self.path, self.config["data"], kinds, _EXPECTED, "data")
        known = {name for name in (*data, "normalization") if f"data.{name}" not in typed}
        return {n: value for n, value in before.items() if value is not None and n in known}


@dataclass(frozen=True)
class StoredNetwork:
    """A file with a network but no settings of a run (imported, exported), and the command line.

    Attributes:
        path: File of the network.
        user_overrides: Arguments of the user, without the file.
        added: Always empty, see `StoredRun`.
    """

    path: Path
    user_overrides: Sequence[str]
    added: Sequence[str] = ()

    @property
    def arguments(self) -> list[str]:
        """Command line for Hydra."""
        return [*self.user_overrides, f"checkpoint={self.path}"]

    def settings(self, composed: Mapping[str, Any]) -> tuple[dict[str, Any], SettingsFile, Any]:
        """Return all settings of the evaluation.

        Args:
            composed: Composed config, resolved.

        Returns:
            Settings, the file that they come from, and the `LoadedNetwork`.

        Raises:
            DataError: The file cannot be used.
        """
        from tangent_train.checkpoints.loaded import load_network
        from tangent_train.inference.engine import views_per_forward
        from tangent_train.inference.representations import panorama_settings

        typed = names_of(self.user_overrides)
        trust = parse_settings(Trust, composed).trust
        trained = load_network(self.path, trust)
        settings = dict(composed)
        level = composed["level"] if "level" in typed else None
        settings["level"] = trained.level if level is None else level
        if "representation" not in typed:
            stored = dict(trained.representation)
            settings["representation"] = (
                stored if level is None else panorama_settings(trained, level)
            )
            for name in typed:
                if name.startswith("representation."):
                    _copy_setting(settings, composed, name.split("."))
        elif not typed & {"level", "representation.level"}:
            settings["representation"] = dict(composed["representation"]) | {"level": trained.level}
        in_file = {"_target_": "models.OnnxNetwork", "path": str(self.path)}
        settings["network"] = in_file if trained.settings is None else trained.settings
        mean, std = list(trained.normalization.mean), list(trained.normalization.std)
        of_network = {"inputs": list(trained.inputs), "normalization": {"mean": mean, "std": std}}
        if "inputs" in composed["data"]:  # images, not shapes
            known = {name: v for name, v in of_network.items() if f"data.{name}" not in typed}
            settings["data"] = dict(composed["data"]) | known
        if (
            "task.eval_view_batch_size" not in typed
        ):  # photo networks have many classes, large images
            count = views_per_forward(trained.image_size)
            settings["task"] = dict(composed["task"]) | {"eval_view_batch_size": count}
        of_user = (composed.keys() - {"network", "representation"}) | typed
        return settings, SettingsFile(self.path, trust, of_user), trained


def stored_run(command: str, arguments: Sequence[str]) -> StoredRun | StoredNetwork | None:
    """Read the settings that a command continues from; None if it starts from the config alone.

    ``tangent-train resume=<run>`` takes the settings in the run's last checkpoint,
    ``tangent-evaluate checkpoint=<file>`` those in the file. In an evaluation ``data=<option>`` (or
    another section) replaces the stored section; the run keeps its experiment. A network without
    settings of a run is evaluated with the user's settings.

    Args:
        command: Name of the command.
        arguments: Command line after the program's name.

    Raises:
        DataError: The file, or its settings, cannot be used.
        SettingError: A typed setting does not fit the run.
    """
    setting = {"train": "resume", "evaluate": "checkpoint"}.get(command, "")
    values = [a.partition("=")[2] for a in arguments if a.startswith(f"{setting}=")]
    if not setting or not values or values[-1] in ("", "null"):
        return None
    files = values_of_sweep(values[-1], arguments)
    if len(files) > 1:
        expected = "a single one: a sweep can change other settings"
        raise SettingError(setting, found=", ".join(files), expected=expected)
    path = Path(path_text(values[-1])).absolute()
    location = [f"{setting}={path}"]
    others = [a for a in arguments if not a.startswith(f"{setting}=")]
    if command == "train":
        location.append(f"hydra.run.dir={quoted(str(path))}")
        path = path / "checkpoints" / "last.ckpt"
        if not path.is_file():
            raise DataError(
                path.parents[1],
                found="no checkpoints/last.ckpt",
                expected="the folder of a started run",
                remedy="Use resume=<run> with the folder that tangent-train printed.",
            )
    if command == "train":
        config = read_checkpoint(path, ("config",))["config"]
    else:
        config = run_settings(path)
        _check_evaluation(path, names_of(others), is_run=config is not None)
        if config is None:
            return StoredNetwork(path, others)
    fixed = (*_SECTIONS, "experiment", "recipe") if command == "train" else ("experiment", "recipe")
    if chosen := [a for a in others if a.partition("=")[0] in fixed]:
        raise SettingError(
            location[0],
            found=f"{chosen[0]} in the same command",
            expected="single settings (data.root=…): the run keeps its options",
        )
    others = [*_remembered(command, path, names_of(others)), *others]
    kinds = {name: _RUN[name] for name in ("choices", "level", "seed")}
    known = check_fields(path, config, kinds, _EXPECTED)
    choices = {g: name for g, name in (known["choices"] or {}).items() if is_own_option(g, name)}
    # A file chooses neither who sees a run nor the callbacks of an evaluation.
    for group in ("logger",) if command == "train" else _NEVER_STORED:
        choices.pop(group, None)
    typed = {a.partition("=")[0] for a in others}.intersection(GROUPS)
    if typed & _SECTIONS.keys():  # the experiment's settings are for the replaced option
        choices = {g: name for g, name in choices.items() if g not in ("experiment", "recipe")}
    added = [f"level={known['level']}", f"seed={known['seed']}"]
    added += [f"{group}={name}" for group, name in choices.items() if group not in typed]
    return StoredRun(path, config, others, added, location)


def run_settings(path: Path) -> dict[str, Any] | None:
    """Return the settings of a run in a checkpoint; None if it contains none.

    Raises:
        DataError: The checkpoint cannot be read.
    """
    if path.suffix.lower() in (".onnx", ".safetensors"):
        return None
    config: dict[str, Any] = read_checkpoint(path, ("config",))["config"]
    return config if "data" in config else None


def _remembered(command: str, path: Path, names: Collection[str]) -> list[str]:
    """Return overrides for this machine that were typed for the run before, but not now.

    The checkpoint's location identifies the run, not its content. An evaluation takes only the
    data from there, no loggers and callbacks.
    """
    sections = {"data", *(_NEVER_STORED if command == "train" else ())} - set(names)
    if path.parent.name != "checkpoints":
        return []
    settings = remembered_settings(path.parents[1], sections).items()
    return [f"{'++' * ('.' in name)}{name}={v}" for name, v in settings if name not in names]


def _check_evaluation(path: Path, typed: set[str], *, is_run: bool) -> None:
    """Refuse an evaluation without data, or with settings of another network or of training."""
    if not is_run and not typed & {"data", "experiment"}:
        raise SettingError(
            "data",
            found=f"none, and {path} has no settings of a run",
            expected="the data set to evaluate it on: data=stanford2d3ds data.root=…",
            remedy="Map the network's classes to those of the data with label_map=.",
        )
    for name in sorted(typed):
        section = name.partition(".")[0]
        if section == "network" and (not is_run or "label_map" in typed):
            raise SettingError(name, found="a value", expected=f"none: the network is in {path}")
        if section in _NOT_EVALUATED:
            expected = "none: tangent-evaluate does not train"
            raise SettingError(name, found="a value", expected=expected, remedy="Remove it.")


def is_own_option(group: str, option: str) -> bool:
    """Return True if the configs of this program contain an option of a group."""
    folder = config_folder() / group
    return group in GROUPS and folder / f"{option}.yaml" in folder.rglob("*.yaml")


def _copy_setting(settings: dict[str, Any], composed: Any, path: Sequence[str]) -> None:
    """Copy one of the composed settings, or remove it if the composed config lacks it.

    Args:
        settings: Settings to change.
        composed: Composed config.
        path: Names of the sections, and of the setting.
    """
    *sections, name = path
    for section in sections:
        composed = composed.get(section) if isinstance(composed, dict) else None
        inner = settings.get(section)
        settings[section] = dict(inner) if isinstance(inner, dict) else {}
        settings = settings[section]
    if isinstance(composed, dict) and name in composed:
        settings[name] = composed[name]
    else:
        settings.pop(name, None)
