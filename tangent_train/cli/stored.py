"""Starting from the settings inside a checkpoint: to go on with a run, or to evaluate it.

Hydra composes what the user says and nothing else: an option here, a single setting there. What the
file says is laid under that as plain data, checked, and never reaches Hydra.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from tangent_train.checkpoints.content import INPUTS, NORMALIZATION, read_checkpoint
from tangent_train.cli.compose import STORED, options_of, search_path
from tangent_train.cli.settings import Trust, typed
from tangent_train.errors import DataError, SettingError
from tangent_train.registry import Text, accept, check_fields, check_plain, named_targets
from tangent_train.setting_rules import flat_settings

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

__all__ = ["CHOOSABLE", "StoredRun", "stored_arguments", "stored_run"]

CHOOSABLE = ("data", "representation", "trainer")
"""Sections that an evaluation may take from a group: all else belongs to the network."""

_CHOSEN = ("data", "experiment", "trainer")
_SECTIONS = (*CHOOSABLE, "network", "task", "optimizer", "scheduler")
_RUN = {
    "choices": dict[str, Text] | None,
    "name": Text,
    "seed": int,
    "level": int,
    "panels": int,
    "tensorboard_images": int,
    "checkpoint_every_n_steps": int | None,
    "ema": float | None,
}
"""Settings outside of the sections."""

_EXPECTED = "the settings of a run"


@dataclass(frozen=True)
class StoredRun:
    """The settings inside a checkpoint, on which those of the command line are laid.

    Attributes:
        path: The checkpoint.
        config: Its settings, unchecked.
        name: Of the config to compose; of the user's own words alone.
        arguments: The command line without what only says which checkpoint it is.
        search: Where Hydra looks for options besides.
    """

    path: Path
    config: Mapping[str, Any]
    name: str
    arguments: Sequence[str]
    search: Sequence[str]

    @property
    def known(self) -> list[str]:
        """The names of all settings."""
        sections = _only(self.config, _SECTIONS)
        inside = [name.split(".") for name, _ in flat_settings(sections)]
        dotted = {".".join(parts[: k + 1]) for parts in inside for k in range(len(parts))}
        return [*_RUN, *sorted(dotted)]

    def additions(self) -> list[str]:
        """The command line for Hydra: every override adds to an empty config."""
        return [_addition(argument) for argument in self.arguments]

    def settings(
        self, said: Mapping[str, Any], chosen: Collection[str]
    ) -> tuple[dict[str, Any], tuple[str, ...]]:
        """All settings of the run that goes on.

        Args:
            said: The composed config of `additions`, resolved.
            chosen: Groups of which it holds an option.

        Returns:
            The settings, and what they may name besides what is registered.

        Raises:
            DataError: The file gives settings that files must not give.
            SettingError: A setting of this machine has to be said.
        """
        trust = (*typed(Trust, said).trust, *named_targets(said))
        of_run = check_fields(self.path, self.config, _RUN, _EXPECTED)
        needed = {name: dict for name in _SECTIONS if name != "scheduler" and name not in chosen}
        check_fields(self.path, self.config, needed, _EXPECTED)
        said = {name: value for name, value in said.items() if name != "trust"}
        own = {n for n, value in flat_settings(said) if n not in of_run or value != of_run[n]}
        sections = _only(self.config, set(_SECTIONS) - set(chosen))
        sections = {name: section for name, section in sections.items() if section is not None}
        for name, section in (("level", "representation"), ("seed", "data")):
            if name in own and section not in chosen:  # in every config it is the same
                said[section] = {name: said[name]} | said.get(section, {})
                own.add(f"{section}.{name}")
        accepted = accept(self.path, _merged(sections, _only(said, sections)), trust, own)
        settings = _merged(of_run | accepted.settings, said)
        if "data" in chosen:
            settings["data"] |= self._of_the_network(settings["data"])
        choices = of_run["choices"] or {}
        if "resume" not in said:  # how many processes evaluate is said anew
            choices = _only(choices, ("data", "experiment"))
        _fill_local(settings, accepted.local, _composed_here(choices, self.search))
        return {"init_from": None, "resume": None, "checkpoint": None} | settings, trust

    def _of_the_network(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """What belongs to the network whatever the data: the fold it left out, and its inputs."""
        kinds = {"fold": int | None, "inputs": INPUTS | None, "normalization": NORMALIZATION | None}
        before = check_fields(self.path, self.config.get("data"), kinds, _EXPECTED, "data")
        typed = {argument.lstrip("+").partition("=")[0] for argument in self.arguments}
        known = {*data, "normalization"} - {name for name in kinds if f"data.{name}" in typed}
        return {n: value for n, value in before.items() if value is not None and n in known}


def _fill_local(
    settings: dict[str, Any], local: Mapping[str, Any], here: Mapping[str, Any]
) -> None:
    """Give settings that only concern this machine the values they have here."""
    for place, theirs in local.items():
        section, _, name = place.partition(".")
        own = here.get(section) or {}
        same = own.get("_target_") == settings[section]["_target_"]
        value = own.get(name) if same else None
        if place == "data.root" and value != theirs:
            raise SettingError(
                place,
                found="no folder, as checkpoints do not say where data lie",
                expected="that of the data set on this machine",
                remedy=f"The run had data.root={theirs!r}: add that if it is right here.",
            )
        if value is not None:
            settings[section][name] = value


def stored_run(command: str, arguments: Sequence[str]) -> StoredRun | None:
    """Start from a stored config where the command goes on from one.

    ``tangent-train resume=<run folder>`` takes the settings inside the run's last checkpoint,
    ``tangent-evaluate checkpoint=<file>`` those inside that, with other sections where
    ``data=<option>``, ``representation=<option>`` or ``trainer=<option>`` says so.

    Args:
        command: train, evaluate, prepare or transfer.
        arguments: The command line after the program's name.

    Raises:
        DataError: There are no usable settings where the argument points.
        SettingError: A run is to be resumed elsewhere.
    """
    given = dict(argument.partition("=")[::2] for argument in arguments)
    if command == "train" and given.get("resume") not in (None, "", "null"):
        folder = _resumed_folder(given, arguments)
        path, base = _last_checkpoint(folder), {"resume": str(folder)}
        run_dir = str(folder).replace("${", r"\${")
    elif command == "evaluate" and given.get("checkpoint") not in (None, "", "null"):
        path = Path(given["checkpoint"].strip("'\"")).absolute()
        base, run_dir = {"checkpoint": str(path)}, "runs/evaluate/${now:%Y-%m-%d_%H-%M-%S}"
    else:
        return None
    config = check_plain(path, read_checkpoint(path, ("config",))["config"], "config")
    # The user's options refer to these two.
    numbers = check_fields(path, config, {"level": int, "seed": int}, _EXPECTED)
    base = {name: text.replace("${", r"\${") for name, text in base.items()}
    hydra = {"run": {"dir": run_dir}, "sweep": {"dir": run_dir}}
    name = STORED + command
    ConfigStore.instance().store(name, {**base, **numbers, "trust": [], "hydra": hydra})
    used = ("checkpoint=", "resume=")
    left = [a for a in arguments if not a.startswith(used)]
    search = search_path(get_args_parser().parse_args(left))
    return StoredRun(path, config, name, left, search)


def _composed_here(choices: Mapping[str, str], search: Sequence[str]) -> Any:
    """The user's own settings of the options a run began with, those that there are here."""
    loader = GlobalHydra.instance().config_loader()
    own = [
        f"{group}={choices[group]}"
        for group in _CHOSEN
        if choices.get(group) in options_of(loader, group, list(search))
    ]
    try:
        return OmegaConf.to_container(compose("train", [*search, *own]), resolve=True)
    except (HydraException, OmegaConfBaseException):  # options that are nothing together
        return {}


def stored_arguments(command: str, arguments: Sequence[str]) -> list[str]:
    """The arguments that say which stored run it is, for a process that goes on with it."""
    found = ["checkpoint=", "resume="] if command in ("train", "evaluate") else []
    return [a for a in arguments if a.startswith(tuple(found))]


def _addition(argument: str) -> str:
    name, equals, value = argument.lstrip("+").partition("=")
    if not equals or argument[0] in "-~" or name.startswith("hydra"):
        return argument
    if name in CHOOSABLE and value[:1] not in "{[":
        return f"+{name}={value}"
    return f"++{name}={value}"


def _resumed_folder(given: Mapping[str, str], arguments: Sequence[str]) -> Path:
    folder = Path(given["resume"].strip("'\"")).absolute()
    # Lightning starts further processes with the run's own folder.
    its_own = Path(given.get("hydra.run.dir", str(folder)).strip("'\"")).absolute() == folder
    elsewhere = [a for a in arguments if a in ("-m", "--multirun")]
    elsewhere += [] if its_own else [f"hydra.run.dir={given['hydra.run.dir']}"]
    if elsewhere:
        raise SettingError(
            f"resume={given['resume']}",
            found=f"{elsewhere[0]} beside it",
            expected="neither a sweep nor another folder: a run goes on in its own",
        )
    return folder


def _last_checkpoint(folder: Path) -> Path:
    path = folder / "checkpoints" / "last.ckpt"
    if not path.is_file():
        raise DataError(
            folder,
            found="no checkpoints/last.ckpt",
            expected="the folder of a run that has begun",
            remedy="Give resume= the folder that tangent-train printed.",
        )
    return path


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings with others laid over them."""
    merged = dict(below)
    for name, value in above.items():
        before = merged.get(name)
        both = isinstance(before, dict) and isinstance(value, dict)
        merged[name] = _merged(before, value) if both else value  # type: ignore[arg-type]
    return merged


def _only(settings: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    return {name: value for name, value in settings.items() if name in names}
