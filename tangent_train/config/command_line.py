"""Explain errors of Hydra in the words of a command line."""

from __future__ import annotations

import re
from typing import Any

from hydra.errors import OverrideParseException
from omegaconf import OmegaConf

from tangent_train.config.help import command_settings
from tangent_train.config.settings import SETTINGS, dotted_names, is_within
from tangent_train.errors import SettingError, nearest


def explained(error: Exception, command: str) -> SettingError | None:
    """Return an error of Hydra as one line, with a remedy; None if Hydra's message is clear.

    Args:
        error: The error.
        command: Name of the command, whose settings are suggested.
    """
    if isinstance(error, OverrideParseException):
        expected = "settings as name=value; other characters in quotes: 'name=\"value\"'"
        return SettingError(error.override, found="text that Hydra cannot read", expected=expected)
    node = getattr(error.__cause__, "parent_node", None)
    typed = re.search(r"use \+([^=]*)=(.*)", str(error), re.DOTALL)
    if node is None or typed is None:
        return None
    remedy = nearest(typed[1], _known(command, node._get_root()))
    return SettingError(typed[1], found=typed[2], expected="a known setting", remedy=remedy)


def _known(command: str, config: Any) -> list[str]:
    """Return the names of groups and settings that a command reads."""
    names = {*dotted_names(OmegaConf.to_container(config, resolve=False))}
    names |= {setting.name for setting in command_settings(command)}
    unread = (*SETTINGS[command].not_read, "hydra")
    return [name for name in sorted(names) if not is_within(name, unread)]
