"""Check names of settings: the config of a command declares them, all others are refused."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields
from difflib import get_close_matches
from functools import cache
from typing import Any

import yaml  # type: ignore[import-untyped]

from tangent_train.cli.command_settings import SETTINGS
from tangent_train.config.build import nearest
from tangent_train.errors import SettingError
from tangent_train.files import config_folder

_COMPLETED = "fine_tuning.optimizer"
"""A section that is completed with the settings of ``optimizer`` and may have any of these."""

_MOST_OPTIONS = 3


@cache
def declared_settings(command: str) -> Mapping[str, Any]:
    """Return the settings that the config of a command declares.

    Args:
        command: Name of the command, e.g. transfer.

    Returns:
        Settings by name. The value of a section without a class, such as ``fine_tuning``, is a
        mapping; other values have no meaning.
    """
    content = yaml.safe_load((config_folder() / f"{command}.yaml").read_text("utf-8"))
    bases = [name for name in content["defaults"] if isinstance(name, str) and name != "_self_"]
    declared = {n: value for base in bases for n, value in declared_settings(base).items()}
    declared |= {n: value for n, value in content.items() if n not in ("defaults", "hydra")}
    return declared | dict.fromkeys(field.name for field in fields(SETTINGS[command]))


def check_names(command: str, settings: Mapping[str, Any], references: str) -> None:
    """Refuse settings that nothing reads.

    Settings inside a section with a class are not checked here: the class refuses unknown ones.

    Args:
        command: Name of the command.
        settings: Composed config of the command, resolved or not.
        references: Text with every ``${…}`` of the config and of Hydra. A top-level setting that
            one of them names counts as read.

    Raises:
        SettingError: A setting is not read; the message names the most similar one.
    """
    declared = declared_settings(command)
    for name, value in _undeclared(settings, declared):
        if not re.search(rf"\$\{{\s*([\w.]+:\s*)?\.*{re.escape(name)}\b", references):
            known = [*_names(declared), *_names(settings, name)]
            known = [other for other in known if not name.startswith(f"{other}.")]
            raise SettingError(
                name,
                found=f"{value}, which tangent-{command} does not read",
                expected=f"a setting that tangent-{command} --help lists",
                remedy=f"{_other_command(command, name) or nearest(name, known)}Remove it.",
            )


def probable_name(command: str, message: str) -> str:
    """Return a question with the setting, option or command that is probably meant, or "".

    Args:
        command: Name of the command.
        message: Hydra's message, which contains the refused name: e.g. ``levels``, which is
            ``representation.levels`` of a run, or ``experiment/demo`` of ``rooms/demo``.
    """
    if option := re.search(r"Could not find '(\w+)/([^']+)'", message):
        group, name = config_folder() / option[1], option[2]
        options = [f.relative_to(group).with_suffix("").as_posix() for f in group.rglob("*.yaml")]
        near = [one for one in sorted(options) if name in one] or get_close_matches(name, options)
        return f"Is {' or '.join(near[:3])} meant? " if near else ""
    setting = re.search(r"Could not override '(?:\w+@)?([\w.]+)'", message)
    if setting is None:
        return ""
    name, declared = setting[1], list(_names(declared_settings(command)))
    inner = {
        f"{section}.{key}": value
        for section in declared
        for file in sorted((config_folder() / section.rpartition(".")[2]).glob("*.yaml"))
        for key, value in (yaml.safe_load(file.read_text("utf-8")) or {}).items()
    }
    if name in inner:
        return f"It is a setting of {_options_with(name)}. "
    for one, value in inner.items():  # but not one that copies the missing setting
        if one.endswith(f".{name}") and value != f"${{{name}}}":
            return f"Is {one} meant? "
    return _other_command(command, name) or nearest(name, [*declared, *inner])


def _options_with(name: str) -> str:
    """Return the options of a group whose files have a setting, e.g. task=depth."""
    section, _, key = name.rpartition(".")
    files = sorted((config_folder() / section.rpartition(".")[2]).glob("*.yaml"))
    stems = [file.stem for file in files if key in (yaml.safe_load(file.read_text("utf-8")) or {})]
    more = " or others" if len(stems) > _MOST_OPTIONS else ""
    return " or ".join(f"{section}={stem}" for stem in stems[:_MOST_OPTIONS]) + more


def _other_command(command: str, name: str) -> str:
    """Return a question with the command that reads a setting, if there is only one, or ""."""
    readers = [c for c in SETTINGS if name.partition(".")[0] in declared_settings(c)]
    return f"Is tangent-{readers[0]} meant? " if len(readers) == 1 and readers != [command] else ""


def _undeclared(
    settings: Mapping[str, Any], declared: Mapping[str, Any], section: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield the names and values of undeclared settings."""
    for key, value in settings.items():
        name = f"{section}{key}"
        has_class = isinstance(value, Mapping) and "_target_" in value
        is_known_section = section and key in declared_settings("train") and has_class
        if key not in declared and not is_known_section:
            yield name, value
        inner = declared.get(key)
        if isinstance(value, Mapping) and isinstance(inner, Mapping) and not has_class:
            yield from _undeclared(value, inner, f"{name}.") if name != _COMPLETED else ()


def _names(settings: Mapping[str, Any], excluded: str = "", section: str = "") -> Iterator[str]:
    """Yield the names of settings and of the settings inside them, except for one."""
    for key, value in settings.items():
        name = f"{section}{key}"
        if name != excluded:
            yield name
            if isinstance(value, Mapping):
                yield from _names(value, excluded, f"{name}.")
