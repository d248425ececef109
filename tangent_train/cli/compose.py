"""Finding, checking and restoring configs, before anything heavy is imported."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from hydra.core.config_loader import ConfigLoader

__all__ = ["check_overrides", "checkpoint_config", "config_folder", "with_stored_config"]


_STORED = "stored_"
"""Begins the names of configs that come from a run or a checkpoint."""

_PLUGINS = {"hydra/launcher/": "hydra-submitit-launcher", "hydra/sweeper/": "hydra-optuna-sweeper"}
"""Packages of the extra ``sweep``, by the config group they add options to."""


def config_folder() -> Path:
    """The Hydra tree: the copy inside the wheel first, the checkout's second."""
    package = Path(__file__).resolve().parents[1]
    packaged = package / "configs"
    return packaged if packaged.is_dir() else package.parent / "configs"


def with_stored_config(command: str, arguments: list[str]) -> tuple[str, list[str]]:
    """Start from a stored config where the command goes on from one.

    ``tangent-train resume=<run folder>`` takes the config inside the run's last checkpoint,
    ``tangent-evaluate checkpoint=<file>`` the one inside that; overrides then apply to it.

    Args:
        command: train, evaluate or prepare.
        arguments: The command line after the program's name.

    Returns:
        The name of the config to compose, and the arguments with the folder to run in.

    Raises:
        DataError: There is no usable config where the argument points.
    """
    given = dict(argument.partition("=")[::2] for argument in arguments)
    if command == "train" and given.get("resume") not in (None, "", "null"):
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
        stored = checkpoint_config(_last_checkpoint(folder))
        stored["resume"] = str(folder)
        arguments = [a for a in arguments if not a.startswith("resume=")]
        run_folder = str(folder)
    elif command == "evaluate" and given.get("checkpoint") not in (None, ""):
        path = Path(given["checkpoint"]).absolute()
        stored = checkpoint_config(path)
        stored["checkpoint"] = str(path)
        arguments = [a for a in arguments if not a.startswith("checkpoint=")]
        run_folder = "runs/evaluate/${now:%Y-%m-%d_%H-%M-%S}"
    else:
        return command, arguments
    stored["hydra"] = {"run": {"dir": run_folder}, "sweep": {"dir": run_folder}}
    ConfigStore.instance().store(_STORED + command, stored)
    return _STORED + command, arguments


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


def checkpoint_config(path: Path) -> dict[str, Any]:
    """The config inside a checkpoint, read without unpickling anything but tensors.

    Raises:
        DataError: The file is missing, no checkpoint, or of another program.
    """
    import torch

    expected = "a checkpoint written by tangent-train"
    if not path.is_file():
        raise DataError(path, found="no such file", expected=expected)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:
        first_line = str(error).partition("\n")[0]
        raise DataError(
            path, found=f"an unreadable file ({first_line})", expected=expected
        ) from error
    if not isinstance(content, dict) or "config" not in content or "state_dict" not in content:
        raise DataError(path, found="no config inside", expected=expected)
    return _plain(OmegaConf.create(content["config"]))


def _plain(config: Any) -> dict[str, Any]:
    container = OmegaConf.to_container(config, resolve=False)
    if not isinstance(container, dict):
        raise DataError("stored config", found=type(container).__name__, expected="a mapping")
    return {str(key): value for key, value in container.items()}


def check_overrides(config_name: str, arguments: list[str]) -> None:
    """Refuse overrides of what does not exist, with the near matches.

    Args:
        config_name: The config they apply to.
        arguments: The command line; options and additions (``+key=…``) are left to Hydra.

    Raises:
        SettingError: A setting, group or option is unknown, or an override cannot be parsed.
    """
    options = get_args_parser().parse_args(arguments)
    texts = options.overrides
    if options.config_dir:
        texts = [*texts, f"hydra.searchpath=['file://{Path(options.config_dir).absolute()}']"]
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        try:
            overrides = OverridesParser.create(config_loader=loader).parse_overrides(texts)
        except OverrideParseException as error:
            raise SettingError(
                f"override '{error.override}'", found="no override", expected="setting=value"
            ) from error
        plain = [o for o in overrides if not (o.is_add() or o.is_delete() or o.is_hydra_override())]
        search = [str(o.input_line) for o in overrides if o.key_or_group == "hydra.searchpath"]
        options_of = {o.key_or_group: _options(loader, o.key_or_group, search) for o in plain}
        groups = [o for o in plain if options_of[o.key_or_group]]
        if groups and config_name.startswith(_STORED):
            raise SettingError(
                groups[0].key_or_group,
                found=f"'{groups[0].input_line}'",
                expected="overrides of single settings, as in data.fold=2",
                remedy="A stored config has its choices made; start a new run for others.",
            )
        for override in groups:
            _check_option(override, options_of[override.key_or_group])
        chosen = [str(o.input_line) for o in groups if not o.is_sweep_override()]
        config = _compose(config_name, [*search, *chosen])
    names = list(dict.fromkeys([*_dotted(config), *_group_names(loader)]))
    for override in plain:
        if override not in groups and override.key_or_group not in names:
            _refuse("setting", override.key_or_group, names)


def _compose(config_name: str, overrides: list[str]) -> DictConfig:
    try:
        return compose(config_name, overrides)
    except MissingConfigException as error:
        missing = str(error.missing_cfg_file)
        for group, package in _PLUGINS.items():
            if missing.startswith(group):
                raise SettingError(
                    missing,
                    found=f"no {package}",
                    expected="the packages for sweeps",
                    remedy="Run: pip install 'tangent-train[sweep]'",
                ) from error
        raise


def _check_option(override: Override, options: list[str]) -> None:
    wanted = (
        override.sweep_string_iterator() if override.is_sweep_override() else [override.value()]
    )
    for option in wanted:
        if str(option) not in options:
            _refuse(override.key_or_group, str(option), options)


def _refuse(kind: str, found: str, known: list[str]) -> None:
    near = difflib.get_close_matches(found, known, n=3, cutoff=0.6)
    listed = ", ".join(known) if len(known) <= 20 else "a setting that --help lists"
    remedy = f"Did you mean {' or '.join(near)}? " if near else ""
    if kind == "setting":
        remedy += f"(+{found}=… adds a setting that the config does not name.)"
    raise SettingError(f"unknown {kind}", found=f"'{found}'", expected=listed, remedy=remedy)


def _options(loader: ConfigLoader, group: str, search: list[str]) -> list[str]:
    """Options of a config group, those of its sub-folders as ``folder/option``."""
    options = list(loader.get_group_options(group, overrides=search))
    for folder in loader.list_groups(group):
        options += [
            f"{folder}/{option}" for option in _options(loader, f"{group}/{folder}", search)
        ]
    return options


def _group_names(loader: ConfigLoader) -> list[str]:
    return [name for name in loader.list_groups("") if name != "hydra"]


def _dotted(config: DictConfig, prefix: str = "") -> Iterator[str]:
    for key in config:
        name = prefix + str(key)
        yield name
        node = config._get_node(key)
        if isinstance(node, DictConfig) and not node._is_none() and not node._is_interpolation():
            yield from _dotted(node, f"{name}.")
