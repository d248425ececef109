"""Settings of commands on files, checked before anything is read.

Each takes the settings, and the name of one of them. Hydra has given them a type by their looks:
``overwrite=no`` is a text.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tangent_train.errors import SettingError

__all__ = ["choice", "flag", "names", "number", "numbers", "optional_whole", "path", "whole"]

Settings = Mapping[str, Any]


def path(settings: Settings, name: str) -> Path | None:
    """A file or folder, ``~`` being the home folder; or None."""
    value = settings[name]
    return None if value is None else Path(str(value)).expanduser()


def whole(settings: Settings, name: str, least: int) -> int:
    """A whole number.

    Raises:
        SettingError: It is none, or less than `least`.
    """
    value = settings[name]
    if type(value) is not int or value < least:
        raise SettingError(name, found=value, expected=f"a whole number, {least} or more")
    return value


def optional_whole(settings: Settings, name: str, least: int) -> int | None:
    """A whole number, or None; see `whole`."""
    return None if settings[name] is None else whole(settings, name, least)


def number(settings: Settings, name: str, least: float, most: float) -> float:
    """A number between two others.

    Raises:
        SettingError: It is none, or not strictly between them.
    """
    value = settings[name]
    if not _is_number(value) or not least < value < most:
        expected = f"a number greater than {least:g}"
        expected += f" and less than {most:g}" if math.isfinite(most) else ""
        raise SettingError(name, found=value, expected=expected)
    return float(value)


def numbers(settings: Settings, name: str, expected: str) -> list[float] | None:
    """A list of numbers, or None.

    Raises:
        SettingError: It is something else; `expected` says what is wanted.
    """
    values = settings[name]
    if values is None:
        return None
    listed = isinstance(values, Sequence) and not isinstance(values, str)
    if not listed or not all(map(_is_number, values)):
        raise SettingError(name, found=values, expected=expected)
    return [float(value) for value in values]


def flag(settings: Settings, name: str) -> bool:
    """Whether something is wanted.

    Raises:
        SettingError: Neither true nor false.
    """
    value = settings[name]
    if not isinstance(value, bool):
        raise SettingError(name, found=value, expected="true or false")
    return value


def names(settings: Settings, name: str) -> tuple[str, ...]:
    """A name, a list of them, or None.

    Raises:
        SettingError: Something else.
    """
    value = settings[name]
    listed = [value] if isinstance(value, str) else value or []
    if not isinstance(listed, Sequence) or not all(isinstance(one, str) for one in listed):
        raise SettingError(name, found=value, expected="a name, or a list of names")
    return tuple(listed)


def choice(settings: Settings, name: str, allowed: tuple[str, ...]) -> Any:
    """One of some words.

    Raises:
        SettingError: Another one.
    """
    value = settings[name]
    if value not in allowed:
        raise SettingError(name, found=value, expected=" or ".join(allowed))
    return value


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and math.isfinite(value)  # type: ignore[arg-type]
