"""Starting from a stored config: of a run to go on with, of a checkpoint to evaluate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from tangent_train.cli.compose import STORED, compose_option, config_folder, search_path
from tangent_train.cli.resume import LATER_SETTINGS
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

__all__ = ["checkpoint_config", "stored_config_arguments", "with_stored_config"]

_CHOOSABLE = ("data", "representation")
"""Sections that an evaluation may take from a group: all else belongs to the network."""

_OF_THE_NETWORK = ("fold", "inputs", "normalization")
"""Settings of the data that a network was trained for."""


def with_stored_config(command: str, arguments: list[str]) -> tuple[str, list[str]]:
    """Start from a stored config where the command goes on from one.

    ``tangent-train resume=<run folder>`` takes the config inside the run's last checkpoint,
    ``tangent-evaluate checkpoint=<file>`` the one inside that, with other sections where
    ``data=<option>`` or ``representation=<option>`` says so; overrides then apply to it. Code that
    is not of this package or the libraries of networks has to be named on the command line, by
    ``trust=<its full name>`` or as an override: a config calls what it names.

    Args:
        command: train, evaluate, prepare or transfer.
        arguments: The command line after the program's name.

    Returns:
        The name of the config to compose, and the arguments with the folder to run in.

    Raises:
        DataError: There is no usable config where the argument points.
        SettingError: An option is unknown, or a run is to be resumed elsewhere.
    """
    given = dict(argument.partition("=")[::2] for argument in arguments)
    if command == "train" and given.get("resume") not in (None, "", "null"):
        stored, folder = _of_run(given, arguments)
    elif command == "evaluate" and _has_checkpoint(arguments):
        path = Path(given["checkpoint"]).absolute()
        stored = checkpoint_config(path, *_trusted(arguments))
        _choose_sections(stored, arguments)
        stored["checkpoint"] = str(path)
        folder = "runs/evaluate/${now:%Y-%m-%d_%H-%M-%S}"
    else:
        return command, arguments
    used = stored_config_arguments(command, arguments)
    stored["hydra"] = {"run": {"dir": folder}, "sweep": {"dir": folder}}
    ConfigStore.instance().store(STORED + command, stored)
    return STORED + command, [a for a in arguments if a not in used]


def stored_config_arguments(command: str, arguments: Sequence[str]) -> list[str]:
    """The arguments that say what the stored config is, which are no overrides of it."""
    names = ["checkpoint=", "resume=", "trust="]
    if command == "evaluate" and _has_checkpoint(arguments):
        names += [f"{group}=" for group in _CHOOSABLE]
    return [a for a in arguments if a.startswith(tuple(names))]


def _has_checkpoint(arguments: Sequence[str]) -> bool:
    return any(a.startswith("checkpoint=") and a != "checkpoint=" for a in arguments)


def _trusted(arguments: Sequence[str]) -> tuple[set[str], set[str]]:
    """Code that the command line names itself, and settings that it replaces."""
    plain = [a.lstrip("+").partition("=")[::2] for a in arguments if "=" in a and a[0] not in "-~"]
    trust = {
        part.strip(" '\"")
        for name, value in plain
        if name == "trust"
        for part in value.strip("[]").split(",")
    }
    # A network that is overridden where it was in the checkpoint is the user's own choice there;
    # one that the checkpoint names elsewhere as well likewise.
    trust |= {value for name, value in plain if name.endswith("._target_")}
    return trust, {name for name, _ in plain}


def _of_run(given: dict[str, str], arguments: list[str]) -> tuple[dict[str, Any], str]:
    """The config of the run to go on with, and its folder."""
    folder = Path(given["resume"]).absolute()
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
    stored = checkpoint_config(_last_checkpoint(folder), *_trusted(arguments))
    stored["resume"] = str(folder)
    return stored, str(folder)


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


def _choose_sections(stored: dict[str, Any], arguments: list[str]) -> None:
    """Put the chosen options in place of the stored sections.

    What they refer to elsewhere in the config, as the level, they take from the stored one. What
    belongs to the network stays: the fold, as it has been trained on the others, and its inputs.
    """
    chosen = [a.partition("=")[::2] for a in stored_config_arguments("evaluate", arguments)]
    chosen = [(group, option) for group, option in chosen if group in _CHOOSABLE]
    if not chosen:
        return
    before = stored.get("data") or {}
    search = search_path(get_args_parser().parse_args(arguments))
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        for group, option in chosen:
            stored[group] = compose_option(group, option.strip("'\""), search)
    for name in _OF_THE_NETWORK:
        if before.get(name) is not None and (name in stored["data"] or name == "normalization"):
            stored["data"][name] = before[name]


def checkpoint_config(
    path: Path, trust: Collection[str] = (), overridden: Collection[str] = ()
) -> dict[str, Any]:
    """The config inside a checkpoint, read without unpickling anything but tensors.

    Args:
        path: The checkpoint.
        trust: Code it may name, see `check_stored`.
        overridden: Settings that the command line replaces.

    Raises:
        DataError: The file is missing, no checkpoint, of another program, or names other code.
    """
    from tangent_train.tasks.stored_settings import check_stored, without_resolvers
    from tangent_train.tasks.trained import read_checkpoint

    content = read_checkpoint(path)
    written = without_resolvers(path, content["config"], content.get("resolved_config"))
    check_stored(path, written, trust, overridden)
    container = OmegaConf.to_container(OmegaConf.create(written), resolve=False)
    if not isinstance(container, dict):
        raise DataError("stored config", found=type(container).__name__, expected="a mapping")
    # A list of defaults would choose sections, and is none of the run's settings.
    stored = {str(key): value for key, value in container.items() if key != "defaults"}
    for name, (value, beside) in LATER_SETTINGS.items():
        section, _, setting = name.rpartition(".")
        inside = stored.get(section) if section else stored
        if isinstance(inside, dict) and beside in inside:
            inside.setdefault(setting, value)
    return stored
