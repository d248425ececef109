"""Check names of settings: the config of a command declares them, all others are refused."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import cache
from typing import Any

import yaml  # type: ignore[import-untyped]

from tangent_train.cli.command_settings import SETTINGS
from tangent_train.errors import SettingError
from tangent_train.files import config_folder
from tangent_train.registry import nearest

_COMPLETED = "fine_tuning.optimizer"
"""A section that is completed with the settings of ``optimizer`` and may have any of these."""


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
                remedy=f"{nearest(name, known)}Remove it.",
            )


def probable_setting(command: str, name: str) -> str:
    """Return a question with the setting that a refused name probably means, or "".

    Args:
        command: Name of the command.
        name: Refused name, e.g. ``levels``, which is ``representation.levels`` of a run.
    """
    declared = declared_settings(command)
    views = yaml.safe_load((config_folder() / "representation/tangent.yaml").read_text("utf-8"))
    if "representation" in declared and name in views:
        return f"Is representation.{name} meant? "
    return nearest(name, _names(declared))


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
