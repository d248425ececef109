"""Words of a command line: refuse those that are not settings, and explain errors of Hydra."""

from __future__ import annotations

import re
from argparse import ArgumentError
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationResolutionError

from tangent_train.config.help import command_settings
from tangent_train.config.settings import (
    SETTINGS,
    config_name,
    dotted_names,
    is_within,
)
from tangent_train.errors import SettingError, first_line, nearest
from tangent_train.files import config_folder

_POSITIONAL = ("checkpoint", "model", "input", "output")
"""Settings that words without a name stand for in other programs, in this order."""

_OF_FILES = {"import": ("file", "output"), "keypoints": ("left", "right", "output")}
"""These settings by the command, if the first word is a file."""


def with_help(arguments: Sequence[str]) -> list[str]:
    """Replace words that mean ``--help``, also misspelled ones.

    >>> with_help(["help", "name=help"]), with_help(["level=5", "--hlep", "--hydra-help"])
    (['--help', 'name=help'], ['level=5', '--help', '--hydra-help'])
    """
    similar = [w for w in arguments if "=" not in w and get_close_matches(w.strip("-"), ["help"])]
    return ["--help" if word in similar and word[0] in "-h" else word for word in arguments]


def check_words(command: str, arguments: Sequence[str]) -> None:
    """Refuse options that Hydra lacks, words without ``=``, and groups without an option.

    Args:
        command: Name of the command, e.g. predict.
        arguments: Command line after the program's name.

    Raises:
        SettingError: There is such a word or group.
    """
    parser, fields = get_args_parser(), SETTINGS[command].model_fields
    parser.allow_abbrev, parser.exit_on_error = False, False
    expected = "settings as name=value"
    try:
        parsed, others = parser.parse_known_args([*arguments])
    except ArgumentError as error:
        name, found = str(error.argument_name).rpartition("/")[2], f"an {error.message}"
        raise SettingError(name, found=found, expected=expected) from error
    for option in (word for word in others if word.startswith("-")):
        name = option.partition("=")[0].strip("-").replace("-", "_")
        config_name(command, ())
        with initialize_config_dir(str(config_folder()), version_base="1.3"):
            remedy = nearest(name, _known(command, compose(command, return_hydra_config=True)))
        raise SettingError(option, found="an option", expected=expected, remedy=remedy)
    words = [word for word in [*parsed.overrides, *others] if not re.search("[=~]", word)]
    if words:
        typed = {word.partition("=")[0] for word in parsed.overrides}
        order = _OF_FILES.get(command, _POSITIONAL) if Path(words[0]).suffix else _POSITIONAL
        names = [name for name in order if name in fields and name not in typed]
        remedy = f"tangent-{command} --help lists them."
        if len(words) <= len(names):
            remedy = f"Did you mean {' '.join(map(typed_setting, names, words))}?"
        raise SettingError(words[0], found="a word without =", expected=expected, remedy=remedy)
    for one in OverridesParser.create().parse_overrides(parsed.overrides):
        group, value, options = one.key_or_group, one.value(), _options(one.key_or_group)
        unread, expected = SETTINGS[command].not_read, f"one of {', '.join(options)}, or ~{group}"
        known = [s.name for s in command_settings(command) if not is_within(s.name, unread)]
        if is_within(group, unread) or (options and group not in known):
            expected = f"no such setting: tangent-{command} does not read it"
            remedy = nearest(group, known) if options else ""
            raise SettingError(group, found="a value", expected=expected, remedy=remedy)
        values = value.list if isinstance(value, ChoiceSweep) else value
        values = values if isinstance(values, list) else [values]
        is_wrong = any(isinstance(name, bool | int | float | None) for name in values)
        if options and is_wrong and not one.is_delete():
            found = str(one.input_line).partition("=")[2]
            raise SettingError(group, found=found, expected=expected)


def _options(group: str) -> list[str]:
    """Return the options of a group in this package."""
    folder = config_folder() / group
    files = (path.relative_to(folder) for path in folder.rglob("*.yaml"))
    return sorted(path.with_suffix("").as_posix() for path in files)


def typed_setting(name: str, value: str) -> str:
    """Return a setting as it is typed in a shell.

    >>> print(typed_setting("input", "holiday/1.jpg"), typed_setting("input", "holiday (1).jpg"))
    input=holiday/1.jpg 'input="holiday (1).jpg"'
    """
    if re.fullmatch(r"[\w./:+-]+", value, re.ASCII):
        return f"{name}={value}"
    return "'" + f'{name}="{value}"'.replace("'", "'\\''") + "'"


def explained(error: Exception, command: str) -> SettingError | None:
    """Return an error of Hydra or OmegaConf as one line, with a remedy; None if it is another.

    Args:
        error: The error.
        command: Name of the command, whose settings are suggested.
    """
    if isinstance(error, OverrideParseException):
        return _unreadable(error.override)
    if isinstance(error, MissingConfigException) and error.options:
        return _missing_option(error)
    if isinstance(error, InterpolationResolutionError):
        reason = re.sub("^.*resolving interpolation: ", "", first_line(error)).strip('"')
        expected = "a setting or variable that exists"
        return SettingError(error.full_key, found=reason, expected=expected)
    node = getattr(error.__cause__, "parent_node", None)
    typed = re.search(r"use \+([^=]*)=(.*)", str(error), re.DOTALL)
    if node is None or typed is None:
        return None
    remedy = nearest(typed[1], _known(command, node._get_root()))
    return SettingError(typed[1], found=typed[2], expected="a known setting", remedy=remedy)


def _missing_option(error: MissingConfigException) -> SettingError:
    """Return the error of an option that a group lacks."""
    named = re.search("Available options in '(.*)'", str(error))
    group = named[1] if named else ""
    option = str(error.missing_cfg_file).removeprefix(f"{group}/")
    options = sorted({*_options(group), *(error.options or ())})
    remedy = nearest(option, options)
    return SettingError(group, found=option, expected=f"one of {', '.join(options)}", remedy=remedy)


def _unreadable(override: str) -> SettingError:
    """Return the error of a setting that Hydra cannot parse."""
    name, _, value = override.partition("=")
    remedy = f"Quote other characters: {typed_setting(name, value)}"
    if value.startswith("~"):
        remedy = f"Type the folder in full: {typed_setting(name, str(Path(value).expanduser()))}"
    expected = "a number, a word, a path, or a list such as [1,2]"
    return SettingError(name, found=value or "nothing", expected=expected, remedy=remedy)


def _known(command: str, config: Any) -> list[str]:
    """Return the names of groups and settings that a command reads."""
    kind = SETTINGS[command]
    names = {*dotted_names(OmegaConf.to_container(config, resolve=False))}
    names |= {setting.name for setting in command_settings(command)}
    known = [name for name in sorted(names) if not is_within(name, (*kind.not_read, "hydra"))]
    is_run = "hydra" in config and config.hydra.run.dir != "."
    return [*known, *["hydra.run.dir"] * is_run]
