"""Settings inside a checkpoint, to resume a run or to evaluate it or any other network.

Hydra composes the user's own config, with the options of the run where the user has options of
these names. The settings of the file are plain data: they are laid over the composed ones, except
for what is typed and what concerns this machine, and never reach Hydra.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from tangent_train.checkpoints.content import INPUTS, NORMALIZATION, read_checkpoint
from tangent_train.cli.command_settings import RunSettings
from tangent_train.cli.compose import config_folder, path_text, quoted, values_of_sweep
from tangent_train.cli.remembered import remembered_settings
from tangent_train.cli.settings import Trust, names_of, parse_settings
from tangent_train.errors import DataError, SettingError
from tangent_train.registry import SettingsFile, Text, check_fields
from tangent_train.setting_rules import from_file

_DECLARED = get_type_hints(RunSettings)
_SECTIONS = {
    name: dict | None if get_args(kind)[1:] == (NoneType,) else dict
    for name, kind in _DECLARED.items()
    if dict in (get_origin(kind), *map(get_origin, get_args(kind))) and from_file(name)
}
"""Sections that a checkpoint keeps, with their kinds."""

_NEVER_STORED = ("callbacks", "debug", "logger")
"""Groups whose settings are never taken from a file: a resumed run composes its options again."""

GROUPS = ("experiment", "recipe", *_SECTIONS, *_NEVER_STORED)
"""Config groups whose chosen options a checkpoint keeps, as ``choices``."""

_RUN = {
    "choices": dict[str, Text] | None,
    "name": Text,
    **{name: kind for name, kind in _DECLARED.items() if name not in GROUPS},
}
"""Settings outside of the sections."""

_EXPECTED = "the settings of a run"


@dataclass(frozen=True)
class StoredRun:
    """The settings inside a checkpoint, and the command line.

    Attributes:
        path: The checkpoint.
        config: Its settings, plain values.
        user_overrides: Overrides of the user, without the checkpoint.
        added: The options of the run among the user's own, its level and seed.
        place: Overrides for the checkpoint and the run folder.
    """

    path: Path
    config: Mapping[str, Any]
    user_overrides: Sequence[str]
    added: Sequence[str]
    place: Sequence[str]

    @property
    def arguments(self) -> list[str]:
        """Command line for Hydra: options, then overrides, of which the last one counts."""
        options = [a for a in self.user_overrides if "=" not in a or a[0] == "-"]
        overrides = [a for a in self.user_overrides if a not in options]
        return [*options, *self.added, *overrides, *self.place]

    def settings(self, composed: Mapping[str, Any]) -> tuple[dict[str, Any], SettingsFile]:
        """All settings of the continued run.

        Args:
            composed: The composed config, resolved.

        Returns:
            The settings, and where they come from.

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
            settings["data"] |= self._of_the_network(settings["data"], typed)
        trust = parse_settings(Trust, composed).trust
        return settings, SettingsFile(self.path, trust, typed | local)

    def _section(
        self, name: str, here: Mapping[str, Any], typed: set[str]
    ) -> tuple[dict[str, Any], set[str]]:
        """A section of the file with machine-specific settings of the user, and their names."""
        stored = self.config[name]
        names = {*stored, *here}
        local = {n for n in names if not from_file(f"{name}.{n}", stored.get(n))}
        section = {n: v for n, v in stored.items() if n not in local}
        same = here.get("_target_") == stored.get("_target_")
        of_user = {n: v for n, v in here.items() if n in local and same}
        section |= of_user
        for n in sorted(local & {"root", "mask"} if name == "data" else ()):
            if f"data.{n}" not in typed and section.get(n) != stored.get(n):
                raise SettingError(
                    f"data.{n}",
                    found="none, as checkpoints do not say where files are",
                    expected="that of the run on this machine",
                    remedy=f"The run had data.{n}={stored.get(n)!r}: add that if it is right here.",
                )
        return section, {f"{name}.{n}" for n in of_user}

    def _of_the_network(self, data: Mapping[str, Any], typed: set[str]) -> dict[str, Any]:
        """Settings tied to the network, not to the data: its test fold and its inputs."""
        kinds = {"fold": int | None, "inputs": INPUTS | None, "normalization": NORMALIZATION | None}
        before = check_fields(self.path, self.config["data"], kinds, _EXPECTED, "data")
        known = {name for name in (*data, "normalization") if f"data.{name}" not in typed}
        return {n: value for n, value in before.items() if value is not None and n in known}


@dataclass(frozen=True)
class StoredNetwork:
    """A network to evaluate whose file knows no run (imported, exported), and the command line.

    Attributes:
        path: The file.
        user_overrides: Overrides of the user, without the file.
        added: Empty, see `StoredRun`.
    """

    path: Path
    user_overrides: Sequence[str]
    added: Sequence[str] = ()

    @property
    def arguments(self) -> list[str]:
        """The command line for Hydra."""
        return [*self.user_overrides, f"checkpoint={self.path}"]

    def settings(self, composed: Mapping[str, Any]) -> tuple[dict[str, Any], SettingsFile, Any]:
        """All settings of the evaluation.

        Args:
            composed: The composed config, resolved.

        Returns:
            The settings, where they come from, and the `TrainedNetwork`.

        Raises:
            DataError: The file cannot be used.
        """
        from tangent_train.checkpoints.trained import load_trained
        from tangent_train.inference.engine import views_per_forward
        from tangent_train.inference.representations import panorama_settings

        typed = names_of(self.user_overrides)
        trust = parse_settings(Trust, composed).trust
        trained = load_trained(self.path, trust)
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
        tied = {"inputs": list(trained.inputs), "normalization": {"mean": mean, "std": std}}
        if "inputs" in composed["data"]:  # images, not shapes
            known = {name: v for name, v in tied.items() if f"data.{name}" not in typed}
            settings["data"] = dict(composed["data"]) | known
        if "task.images_per_forward" not in typed:  # photo networks have many classes, large images
            at_once = views_per_forward(trained.image_size)
            settings["task"] = dict(composed["task"]) | {"images_per_forward": at_once}
        of_user = (composed.keys() - {"network", "representation"}) | typed
        return settings, SettingsFile(self.path, trust, of_user), trained


def stored_run(command: str, arguments: Sequence[str]) -> StoredRun | StoredNetwork | None:
    """Start from a stored config if the command continues from one.

    ``tangent-train resume=<run folder>`` takes the settings inside the run's last checkpoint,
    ``tangent-evaluate checkpoint=<file>`` those inside that; ``data=<option>`` (or another section)
    takes the user's own option in place of the stored section; the run keeps its experiment. A
    network without a run is evaluated with the user's settings.

    Args:
        command: Any command.
        arguments: The command line after the program's name.

    Raises:
        DataError: There are no usable settings where the argument points.
        SettingError: A resumed run would become another one.
    """
    setting = {"train": "resume", "evaluate": "checkpoint"}.get(command, "")
    given = [a.partition("=")[2] for a in arguments if a.startswith(f"{setting}=")]
    if not setting or not given or given[-1] in ("", "null"):
        return None
    files = values_of_sweep(given[-1], arguments)
    if len(files) > 1:
        expected = "one in a sweep, which is over settings of its run"
        raise SettingError(setting, found=", ".join(files), expected=expected)
    path = Path(path_text(given[-1])).absolute()
    place = [f"{setting}={path}"]
    left = [a for a in arguments if not a.startswith(f"{setting}=")]
    if command == "train":
        place.append(f"hydra.run.dir={quoted(str(path))}")
        path = path / "checkpoints" / "last.ckpt"
        if not path.is_file():
            raise DataError(
                path.parents[1],
                found="no checkpoints/last.ckpt",
                expected="the folder of a started run",
                remedy="Give resume= the folder that tangent-train printed.",
            )
    if command == "train":
        config = read_checkpoint(path, ("config",))["config"]
    else:
        config = run_settings(path)
        _check_evaluation(path, names_of(left), of_run=config is not None)
        if config is None:
            return StoredNetwork(path, left)
    kept = (*_SECTIONS, "experiment", "recipe") if command == "train" else ("experiment", "recipe")
    if chosen := [a for a in left if a.partition("=")[0] in kept]:
        raise SettingError(
            place[0],
            found=f"{chosen[0]} beside it",
            expected="single settings (data.root=…): the run keeps its options",
        )
    left = [*_remembered(command, path, names_of(left)), *left]
    kinds = {name: _RUN[name] for name in ("choices", "level", "seed")}
    known = check_fields(path, config, kinds, _EXPECTED)
    choices = {g: name for g, name in (known["choices"] or {}).items() if is_own_option(g, name)}
    # A file does not choose who sees a run, nor what else an evaluation does.
    for group in ("logger",) if command == "train" else _NEVER_STORED:
        choices.pop(group, None)
    typed = {a.partition("=")[0] for a in left}.intersection(GROUPS)
    if typed & _SECTIONS.keys():  # an experiment's settings of a section are for another option
        choices = {g: name for g, name in choices.items() if g not in ("experiment", "recipe")}
    added = [f"level={known['level']}", f"seed={known['seed']}"]
    added += [f"{group}={name}" for group, name in choices.items() if group not in typed]
    return StoredRun(path, config, left, added, place)


def run_settings(path: Path) -> dict[str, Any] | None:
    """Return the settings of a run in a checkpoint; None without settings of a run.

    Raises:
        DataError: It cannot be read.
    """
    if path.suffix.lower() in (".onnx", ".safetensors"):
        return None
    config: dict[str, Any] = read_checkpoint(path, ("config",))["config"]
    return config if "data" in config else None


def _remembered(command: str, path: Path, names: Collection[str]) -> list[str]:
    """Overrides of a run for this machine that were typed before, but not now.

    They count as typed. Which run it is follows from where the checkpoint is, not from what is in
    it. An evaluation has loggers and callbacks of its own.
    """
    sections = {"data", *(_NEVER_STORED if command == "train" else ())} - set(names)
    if path.parent.name != "checkpoints":
        return []
    settings = remembered_settings(path.parents[1], sections).items()
    return [f"{'++' * ('.' in name)}{name}={v}" for name, v in settings if name not in names]


def _check_evaluation(path: Path, typed: set[str], *, of_run: bool) -> None:
    """Refuse to evaluate a network without data, or with settings of another network."""
    if not of_run and not typed & {"data", "experiment"}:
        raise SettingError(
            "data",
            found=f"none, and {path} has no settings of a run",
            expected="the data set to evaluate it on: data=stanford2d3ds data.root=…",
            remedy="class_map= gives the network the classes of the data.",
        )
    others = sorted(name for name in typed if name.partition(".")[0] == "network")
    if others and (not of_run or "class_map" in typed):
        raise SettingError(others[0], found="a value", expected=f"none: the network is in {path}")


def is_own_option(group: str, option: str) -> bool:
    """Return True for an option in the configs of this program."""
    folder = config_folder() / group
    return group in GROUPS and folder / f"{option}.yaml" in folder.rglob("*.yaml")


def _copy_setting(settings: dict[str, Any], composed: Any, place: Sequence[str]) -> None:
    """Copy one of the composed settings; remove it where there is none."""
    *sections, name = place
    for section in sections:
        composed = composed.get(section) if isinstance(composed, dict) else None
        inner = settings.get(section)
        settings[section] = dict(inner) if isinstance(inner, dict) else {}
        settings = settings[section]
    if isinstance(composed, dict) and name in composed:
        settings[name] = composed[name]
    else:
        settings.pop(name, None)
