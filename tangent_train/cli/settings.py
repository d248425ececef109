"""Parse the settings of a command into an object with typed fields."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from tangent_train.errors import SettingError

_Settings = TypeVar("_Settings")

_DESCRIPTIONS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a name or path",
    Path: "a file or folder",
    NoneType: "null",
    dict: "a section of settings",
}


@dataclass(frozen=True)
class Trust:
    """Classes and functions that settings in files may name besides the registered ones."""

    trust: tuple[str, ...]


def parse_settings(kind: type[_Settings], config: Mapping[str, Any]) -> _Settings:
    """Build a dataclass of settings, checking types; ranges are checked where a value is used.

    Annotations may be ``bool``, ``int``, ``float``, ``str``, `Path`, ``None``, `Literal`, tuples,
    sections (``dict``) and unions of these. A single value is accepted for a tuple.

    Args:
        kind: Dataclass to build.
        config: Values by name; names that are not fields are ignored.

    Raises:
        SettingError: A value is missing or has another type.
    """
    defaults = {one.name for one in fields(kind) if one.default is not MISSING}  # type: ignore[arg-type]
    hints = get_type_hints(kind).items()
    named = [(name, hint) for name, hint in hints if name in config or name not in defaults]
    return kind(**{name: _checked_value(name, config.get(name), hint) for name, hint in named})


def names_of(arguments: Sequence[str]) -> set[str]:
    """Return the names of the settings in overrides, without Hydra's."""
    names = {a.lstrip("+~").partition("=")[0] for a in arguments if not a.startswith("-")}
    return {name for name in names if not name.startswith("hydra")}


def check_unread(settings: Any, reason: str, **unread: Any) -> None:
    """Refuse settings that nothing would read.

    Args:
        settings: Settings of a command.
        reason: Reason that nothing reads them, after their value: "for photos".
        **unread: Value of each setting when it is not used.

    Raises:
        SettingError: A setting has another value.
    """
    for name, unused in unread.items():
        if (found := getattr(settings, name)) != unused:
            expected = f"{'null' if unused is None else unused} {reason}"
            raise SettingError(name, found=found, expected=expected)


def check_new(settings: Any, *outputs: Path | None) -> None:
    """Refuse to replace existing files and folders unless `settings.overwrite` is True.

    Empty folders may be used.

    Raises:
        SettingError: A file, or a folder with content, exists.
    """
    for path in () if settings.overwrite else filter(None, outputs):
        if any(path.iterdir()) if path.is_dir() else path.exists():
            raise SettingError(
                "output",
                found=f"{path}, which exists",
                expected="a path that does not exist yet",
                remedy="Give another output, or overwrite=true.",
            )


def _checked_value(name: str, value: Any, hint: Any) -> Any:
    options = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    for option in options:
        with suppress(TypeError, ValueError):
            return _convert(option, value)
    found = "null" if value is None else value
    raise SettingError(name, found=found, expected=" or ".join(map(_description, options)))


def _convert(kind: Any, value: Any) -> Any:
    arguments = get_args(kind)
    if get_origin(kind) is Literal and value in arguments:
        return value
    if get_origin(kind) is tuple:
        values = value if isinstance(value, list | tuple) else [value]
        kinds = arguments[:1] * len(values) if arguments[-1] is ... else arguments
        return tuple(_convert(each, one) for one, each in zip(values, kinds, strict=True))
    if get_origin(kind) is dict and isinstance(value, Mapping):
        return dict(value)
    if kind is Path and isinstance(value, str):
        return Path(value)
    if kind is float and type(value) in (int, float) and math.isfinite(value):
        return float(value)
    if type(value) is kind and kind is not float:
        return value
    raise TypeError


def _description(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return " or ".join(map(str, get_args(kind)))
    if get_origin(kind) is tuple:
        return f"a list (each {_description(get_args(kind)[0])})"
    return _DESCRIPTIONS[get_origin(kind) or kind]
