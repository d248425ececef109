"""Finding configs and checking overrides, before anything heavy is imported."""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString
from hydra.errors import (
    ConfigCompositionException,
    MissingConfigException,
    OverrideParseException,
)
from omegaconf import DictConfig, OmegaConf

from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from argparse import Namespace
    from collections.abc import Iterator, Sequence

    from hydra.core.config_loader import ConfigLoader

__all__ = [
    "STORED",
    "check_overrides",
    "compose_option",
    "config_folder",
    "options_of",
    "quote_path",
    "search_path",
]

STORED = "stored_"
"""Begins the names of configs that come from a run or a checkpoint."""

_PLUGINS = {"hydra/launcher/": "hydra-submitit-launcher", "hydra/sweeper/": "hydra-optuna-sweeper"}
"""Packages of the extra ``sweep``, by the config group they add options to."""

_PATHS = ("back", "cameras", "checkpoint", "depth", "figure", "input", "left", "output", "right")
"""Settings of export, keypoints, predict and render that name files or folders."""

_KEYPOINTS = "keypoints"
_PAIRS = ("stanford2d3ds_pairs", "synthrooms_pairs")
"""Data that only it takes."""

_TRANSFER = "transfer"
_OF_TRANSFER = ("photos", "fine_tuning")
"""Sections that only its experiments have."""


def config_folder() -> Path:
    """The Hydra tree: the copy inside the wheel first, the checkout's second."""
    package = Path(__file__).resolve().parents[1]
    packaged = package / "configs"
    return packaged if packaged.is_dir() else package.parent / "configs"


def quote_path(argument: str) -> str:
    """An override of a setting of `_PATHS` so that Hydra takes its value as it is.

    >>> quote_path("input=holiday (1)/a=b,c.jpg"), quote_path("level=7"), quote_path("depth=null")
    ("input='holiday (1)/a=b,c.jpg'", 'level=7', 'depth=null')
    """
    name, _, value = argument.partition("=")
    if name not in _PATHS or value in ("", "null") or value[0] in "'\"":
        return argument
    plain = value.replace("${", r"\${")  # no interpolation
    return f"{name}={QuotedString(plain, Quote.single).with_quotes()}"


def search_path(options: Namespace) -> list[str]:
    """The override that makes Hydra look into the folder of ``--config-dir`` as well."""
    if not options.config_dir:
        return []
    folder = str(Path(options.config_dir).absolute()).replace("'", r"\'")
    return [f"hydra.searchpath=['file://{folder}']"]


def compose_option(group: str, option: str, search: Sequence[str] = ()) -> dict[str, Any]:
    """An option of a config group by itself; what it refers to elsewhere is left as it is.

    Hydra must be initialized.

    Args:
        group: The group, without folders.
        option: The option.
        search: From `search_path`; Hydra's own, inside a command.

    Raises:
        SettingError: There is no such option.
    """
    options = options_of(GlobalHydra.instance().config_loader(), group, list(search))
    if option not in options:
        _refuse(group, option, options)
    config = OmegaConf.to_container(compose(f"{group}/{option}", list(search)), resolve=False)
    section: dict[str, Any] = config[group]  # type: ignore[index, call-overload, assignment]
    return section


def check_overrides(
    config_name: str,
    arguments: Sequence[str],
    known: Sequence[str] = (),
    choosable: Sequence[str] = (),
) -> None:
    """Refuse overrides of what does not exist, with the near matches.

    Args:
        config_name: The config they apply to.
        arguments: The command line; options and additions (``+key=…``) are left to Hydra.
        known: Names of settings besides those of the config: of a stored one.
        choosable: Groups of which a stored config takes options.

    Raises:
        SettingError: A setting, group or option is unknown, an override cannot be parsed, or an
            experiment belongs to another command.
    """
    options = get_args_parser().parse_args(list(arguments))
    if options.multirun and config_name == _TRANSFER:
        raise SettingError(
            "-m", found="a sweep", expected="folds=[1,2,3] and seeds=[0,1,2], settings of its own"
        )
    texts = [*options.overrides, *search_path(options)]
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
        known_options = {o.key_or_group: options_of(loader, o.key_or_group, search) for o in plain}
        groups = [o for o in plain if known_options[o.key_or_group]]
        stored = config_name.startswith(STORED)
        made = [o for o in groups if stored and o.key_or_group not in choosable]
        if made:
            raise SettingError(
                made[0].key_or_group,
                found=f"'{made[0].input_line}'",
                expected="overrides of single settings, as in data.fold=2"
                + (f", or options of {', '.join(choosable)}" if choosable else ""),
                remedy="A stored config has its choices made; start a new run for others.",
            )
        for override in groups:
            _check_option(override, known_options[override.key_or_group])
            _check_pairs(override, config_name)
        chosen = [str(o.input_line) for o in groups if not o.is_sweep_override()]
        chosen = [f"+{text}" for text in chosen] if stored else chosen
        config = _compose(config_name, search, chosen)
        _check_experiment(config_name, config, chosen)
    names = list(dict.fromkeys([*known, *_dotted(config), *_group_names(loader)]))
    for override in plain:
        if override not in groups and override.key_or_group not in names:
            _refuse("setting", override.key_or_group, names)


def _compose(config_name: str, search: list[str], chosen: list[str]) -> DictConfig:
    try:
        return compose(config_name, [*search, *chosen])
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
    except ConfigCompositionException as error:
        first_line = str(error).partition("\n")[0]
        if any(f"@{section}." in first_line for section in _OF_TRANSFER):
            raise _of_another_command(_experiment(chosen)) from error
        raise SettingError(
            f"config '{config_name}'", found=first_line, expected="groups that it has"
        ) from error


def _check_experiment(config_name: str, config: DictConfig, chosen: list[str]) -> None:
    """Refuse experiments of tangent-transfer elsewhere."""
    experiment = _experiment(chosen)
    if experiment is None or config_name.startswith(STORED):
        return
    if config_name != _TRANSFER and any(section in config for section in _OF_TRANSFER):
        raise _of_another_command(experiment)


def _experiment(chosen: list[str]) -> str | None:
    return next((text for text in chosen if text.startswith("experiment=")), None)


def _of_another_command(experiment: str | None) -> SettingError:
    which = experiment or "experiment"
    return SettingError(
        which,
        found="an experiment of tangent-transfer",
        expected="one of this command",
        remedy=f"Run: tangent-transfer {which}",
    )


def _check_option(override: Override, options: list[str]) -> None:
    wanted = (
        override.sweep_string_iterator() if override.is_sweep_override() else [override.value()]
    )
    for option in wanted:
        if str(option) not in options:
            _refuse(override.key_or_group, str(option), options)


def _check_pairs(override: Override, config_name: str) -> None:
    """Refuse pairs of panoramas where panoramas are wanted."""
    data = str(override.value())
    if override.key_or_group == "data" and data in _PAIRS and config_name != _KEYPOINTS:
        raise SettingError(
            "data",
            found=f"{data}, pairs of panoramas",
            expected="data of this command",
            remedy=f"Run: tangent-keypoints data={data} output=…",
        )


def _refuse(kind: str, found: str, known: list[str]) -> None:
    near = difflib.get_close_matches(found, known, n=3, cutoff=0.6)
    listed = ", ".join(known) if len(known) <= 20 else "a setting that --help lists"
    remedy = f"Did you mean {' or '.join(near)}? " if near else ""
    if kind == "setting":
        remedy += f"(+{found}=… adds a setting that the config does not name.)"
    raise SettingError(f"unknown {kind}", found=f"'{found}'", expected=listed, remedy=remedy)


def options_of(loader: ConfigLoader, group: str, search: list[str]) -> list[str]:
    """Options of a config group, those of its sub-folders as ``folder/option``."""
    options = list(loader.get_group_options(group, overrides=search))
    for folder in loader.list_groups(group):
        options += [
            f"{folder}/{option}" for option in options_of(loader, f"{group}/{folder}", search)
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
