"""Objects made of settings, and which of them the settings inside a file may name.

A section of a config says by ``_target_`` what is made of it. In a config folder or on the command
line its owner wrote that, and any class or function may be named. Settings inside a file may be
anybody's. They are plain data: `accept` compares them with the registered classes that they name
and with the types of those classes' own arguments, and nothing in them is ever interpreted: no
interpolations, no positional arguments, no paths and no addresses. `make` is the only code that
turns settings into objects.

This module imports nothing heavy: networks and data sets import it.
"""

from __future__ import annotations

import builtins
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from tangent_train.errors import DataError, SettingError, printable

__all__ = [
    "Accepted",
    "Local",
    "Object",
    "Text",
    "Weights",
    "accept",
    "check_fields",
    "check_plain",
    "import_named",
    "make",
    "maker_of",
    "named_targets",
    "registered",
]

_HOMES = ("datamodules", "models", "tangent_train.rendering", "tangent_train.tasks")
"""Packages whose public names files may give, where they are registered."""

_WORD = re.compile(r"([A-Za-z0-9][\w.+ -]{0,99})?", re.ASCII)
"""A text in settings: no path, no address, no name of Hydra's, nothing to interpret."""

_LINE = re.compile(r"[^\x00-\x1f\x7f-\x9f]*")
"""A text without commands for terminals."""

_DEEPEST = 12
_PLAIN = (bool, int, float, str, NoneType, dict)
_CALLED_LATER = ("mixer", "optimizer", "scheduler")
"""Settings that are functions which still take something."""

_EXTRAS = {"segmentation_models_pytorch": "networks", "timm": "networks"}
"""Packages that an extra of this one installs."""


class Local:
    """A kind of setting: of this machine, never taken from a file, as paths and compilers are."""


class Object:
    """A kind of setting: another registered object."""


class Text:
    """A kind of setting: any line that is only ever shown, as names of classes."""


class Weights:
    """A kind of setting: names trained weights. Null in a file, whose own tensors are used."""


_registered: set[Any] = set()
_Registered = TypeVar("_Registered", bound=Callable[..., Any])


def registered(made: _Registered) -> _Registered:
    """Let settings in files name a class or function.

    They may give its arguments by name, as the annotations say: numbers, words (`Literal` or
    ``str``), sequences and mappings of these, other registered objects. An argument that may be a
    `Path` or `Any` is not taken from files.
    """
    _registered.add(made)
    return made


class Accepted(NamedTuple):
    """Settings of a file that may be used.

    Attributes:
        settings: Without those of kind `Local`.
        local: Those, by their place.
    """

    settings: dict[str, Any]
    local: dict[str, Any]


def accept(
    path: Path,
    sections: Mapping[str, Any],
    trust: Collection[str] = (),
    own: Collection[str] = (),
) -> Accepted:
    """Check the sections of a config from a file.

    Args:
        path: The file, for the message.
        sections: Each with a ``_target_``.
        trust: Full names of further classes and functions that the user trusts. Their settings
            may be any plain values.
        own: Places (``data.fold``) whose values are the user's own, with all below them.

    Raises:
        DataError: There is a setting that a file must not give; which, and how to allow it.
    """
    check = _Check(path, trust, own)
    plain = {name: check_plain(path, section, name) for name, section in sections.items()}
    settings = {name: check.object(section, name) for name, section in plain.items()}
    return Accepted(settings, check.local)


class _Check:
    """The settings of one file."""

    def __init__(self, path: Path, trust: Collection[str], own: Collection[str]) -> None:
        self.local: dict[str, Any] = {}
        self._path = path
        self._trust = trust
        self._own = own

    def object(self, settings: Any, place: str) -> dict[str, Any]:
        if not isinstance(settings, Mapping) or "_target_" not in settings:
            raise self._refused(place, settings, "a section with a _target_")
        target = settings["_target_"]
        trust = (*self._trust, target) if self._is_own(f"{place}._target_") else self._trust
        _, kinds = _find(target, trust)
        if kinds is None:
            raise DataError(
                self._path,
                found=f"{place}._target_={target}, which would be called",
                expected="networks, data and tasks that are registered here",
                remedy=f"If you know it, and trust who made the file: trust={target}",
            )
        made: dict[str, Any] = {n: None for n, kind in kinds.items() if kind is Weights}
        made["_target_"] = target
        for name, value in settings.items():
            here = f"{place}.{name}"
            kind = kinds.get(name, kinds.get("**"))
            if name == "_partial_" and place.rpartition(".")[2] in _CALLED_LATER:
                kind = bool
            if self._is_own(here):
                made[name] = value
            elif kind is None and name != "_target_":
                raise self._refused(here, value, f"a setting of {target} ({', '.join(kinds)})")
            elif kind is Local:
                self.local[here] = value
            elif name not in made:
                made[name] = self._value(value, kind, here)
        return made

    def _value(self, value: Any, kind: Any, place: str) -> Any:
        if kind is Any and isinstance(value, Mapping) and "_target_" not in value:
            return {name: self._value(v, Any, f"{place}.{name}") for name, v in value.items()}
        if kind is Any and isinstance(value, list):
            return [self._value(v, Any, f"{place}.{k}") for k, v in enumerate(value)]
        if isinstance(value, Mapping) and kind in (Any, Object):
            return self.object(value, place)
        if value is not None and kind is not Any and (kind is Object or not _fits(value, kind)):
            raise self._refused(place, value, f"{inspect.formatannotation(kind)} in a file")
        return value

    def _is_own(self, place: str) -> bool:
        return any(place == own or place.startswith(f"{own}.") for own in self._own)

    def _refused(self, place: str, value: Any, expected: str) -> DataError:
        remedy = f"On the command line {place}=… may be anything."
        return DataError(self._path, found=f"{place}={value!r}", expected=expected, remedy=remedy)


def check_fields(
    path: Path, content: Any, kinds: Mapping[str, Any], expected: str, where: str = ""
) -> dict[str, Any]:
    """The fields of a mapping in a file, each of its kind.

    Args:
        path: The file, for the message.
        content: The mapping.
        kinds: Of every field; one that may be missing is a union with None.
        expected: What the file should be.
        where: In it, for the message.

    Returns:
        These fields; None where they are missing.

    Raises:
        DataError: It is no mapping, or a field is missing or of another kind.
    """
    inside = f"in {where}" if where else "inside"
    if not isinstance(content, Mapping):
        found = f"{type(content).__name__} instead of a mapping {inside}"
        raise DataError(path, found=found, expected=expected)
    for name, kind in kinds.items():
        value = content.get(name)
        if not _fits(value, kind):
            found = f"no {name} {inside}" if value is None else f"{name}={value!r} {inside}"
            raise DataError(path, found=found, expected=expected)
    return {name: content.get(name) for name in kinds}


def check_plain(path: Path, value: Any, place: str, depth: int = 0) -> Any:
    """Plain values of a file: numbers, texts, lists and mappings of these.

    Args:
        path: The file, for the message.
        value: The values.
        place: Of them in the file, for the message.
        depth: In what they are already.

    Raises:
        DataError: There is something else, or they are nested without end.
    """
    expected = f"plain values, at most {_DEEPEST} inside each other"
    if depth > _DEEPEST:
        raise DataError(path, found=f"more of them in {place[:80]}…", expected=expected)
    if isinstance(value, Mapping) and all(type(name) is str for name in value):
        return {n: check_plain(path, v, f"{place}.{n}", depth + 1) for n, v in value.items()}
    if isinstance(value, list | tuple):
        return [check_plain(path, v, f"{place}.{k}", depth + 1) for k, v in enumerate(value)]
    plain = value is None or type(value) in (bool, int, float)
    if plain or (type(value) is str and printable(value) == value):
        return value
    raise DataError(path, found=f"{place}={value!r}", expected=expected)


def make(
    settings: Mapping[str, Any], place: str, trust: Collection[str] | None = None, **given: Any
) -> Any:
    """What a section of a config describes.

    Args:
        settings: ``_target_``, named settings for it, which may be such sections themselves, and
            perhaps ``_partial_: true`` for a function that still takes further ones.
        place: Of the section, for messages.
        trust: For settings of a file, after `accept`: what it may name besides what is registered.
            None for the user's own, which may name anything.
        **given: Further arguments, handed on as they are.

    Raises:
        SettingError: There is no such class or function, or it does not take these settings.
        DataError: What is made says that a file cannot be used.
    """
    maker = maker_of(settings, place, trust)
    own = {name: value for name, value in settings.items() if name not in ("_target_", "_partial_")}
    arguments = {n: _made(v, f"{place}.{n}", trust) for n, v in own.items()} | given
    if settings.get("_partial_"):
        return partial(maker, **arguments)
    try:
        return maker(**arguments)
    except (DataError, SettingError):
        raise
    except Exception as error:
        raise SettingError(
            place,
            found=f"{settings['_target_']}, which cannot be made ({_said(error)})",
            expected="settings that it takes",
            remedy=_missing_package(error),
        ) from error


def maker_of(settings: Mapping[str, Any], place: str, trust: Collection[str] | None = None) -> Any:
    """The class or function that a section names; see `make`."""
    target = settings.get("_target_")
    found = import_named(target, f"{place}._target_") if trust is None else _find(target, trust)[0]
    if found is None:
        raise SettingError(f"{place}._target_", found=target, expected="a registered name")
    return found


def named_targets(settings: Any) -> set[str]:
    """All that settings name as ``_target_``."""
    inner = settings.values() if isinstance(settings, Mapping) else settings
    listed = isinstance(settings, Mapping | list)
    named = {str(settings["_target_"])} if listed and "_target_" in settings else set()
    return named.union(*map(named_targets, inner)) if listed else named


def _made(value: Any, place: str, trust: Collection[str] | None) -> Any:
    if isinstance(value, Mapping):
        if "_target_" in value:
            return make(value, place, trust)
        return {name: _made(inner, f"{place}.{name}", trust) for name, inner in value.items()}
    if isinstance(value, list):
        return [_made(inner, f"{place}.{k}", trust) for k, inner in enumerate(value)]
    return value


def _find(target: Any, trust: Collection[str]) -> tuple[Any, Mapping[str, Any] | None]:
    """What a file may name, with the kinds of its settings; of a trusted one all are `Any`."""
    if not isinstance(target, str):
        return None, None
    module, _, name = target.rpartition(".")
    if module in _HOMES:
        home = import_module(module)
        made = getattr(home, name) if name in home.__all__ else None
        if made in _registered:
            return made, _kinds(made)
    from tangent_train import libraries

    found = libraries.find(module, name)
    if found is None and target in trust:
        return import_named(target, "_target_"), {"**": Any}
    return found or (None, None)


class _Names(dict[str, Any]):
    """Names in the annotations of a function; those only type checkers know are of objects."""

    def __init__(self, names: Mapping[str, Any]) -> None:
        known = {"Callable": Callable, "Mapping": Mapping, "Path": Path, "Sequence": Sequence}
        super().__init__(known | dict(names))

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, Object)


def _kinds(made: Any) -> dict[str, Any]:
    """By the name of an argument what a file may give for it; also those handed on to bases."""
    kinds: dict[str, Any] = {}
    if is_dataclass(made):
        return _kinds_of_fields(made)
    for base in inspect.getmro(made) if inspect.isclass(made) else (made,):
        function = vars(base).get("__init__") if inspect.isclass(base) else base
        if function is None:
            continue
        hints = get_type_hints(function, localns=_Names(inspect.unwrap(function).__globals__))
        arguments = inspect.signature(function).parameters.values()
        of_base = {a.name: _kind(hints[a.name]) for a in arguments if a.name in hints}
        kinds = {**{n: k for n, k in of_base.items() if n != "settings"}, **kinds}
        if not any(a.kind is a.VAR_KEYWORD for a in arguments):
            break
    return kinds


def _kinds_of_fields(made: Any) -> dict[str, Any]:
    """The same of a dataclass: each field by the annotation in the class that declares it."""
    given = {one.name for one in fields(made) if one.init}
    kinds: dict[str, Any] = {}
    for base in reversed(inspect.getmro(made)):
        own = SimpleNamespace(
            __annotations__={n: h for n, h in inspect.get_annotations(base).items() if n in given}
        )
        hints = get_type_hints(own, localns=_Names(vars(sys.modules[base.__module__])))
        kinds |= {name: _kind(hint) for name, hint in hints.items()}
    return kinds


def _kind(hint: Any) -> Any:
    members = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if any(m in (Any, Path, object) or Any in get_args(m) for m in members):
        return Local
    plain = [member for member in members if _is_plain(member)]
    return Union[tuple(plain)] if set(plain) - {NoneType} else Object  # noqa: UP007 - of a list


def _is_plain(hint: Any) -> bool:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType, Sequence, Mapping, list, dict):
        return all(map(_is_plain, arguments))
    return hint in _PLAIN or origin is Literal


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a kind: a plain type, or one of the kinds of this module."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in arguments)
    if origin is Literal:
        return any(type(value) is type(one) and value == one for one in arguments)
    if origin is tuple:
        fits = isinstance(value, list | tuple) and len(value) == len(arguments)
        return fits and all(map(_fits, value, arguments))
    if origin in (Sequence, list):
        return isinstance(value, list | tuple) and all(_fits(v, arguments[0]) for v in value)
    if origin in (Mapping, dict):
        return isinstance(value, Mapping) and all(
            _fits(name, str) and _fits(inner, arguments[1]) for name, inner in value.items()
        )
    if kind is str:
        return isinstance(value, str) and _WORD.fullmatch(value) is not None
    if kind is Text:
        return isinstance(value, str) and _LINE.fullmatch(value) is not None
    if kind is dict:
        return isinstance(value, Mapping)
    return type(value) in (int, float) if kind is float else type(value) is kind


def import_named(target: Any, place: str) -> Any:
    """What a full name names.

    Raises:
        SettingError: It cannot be imported.
    """
    try:
        return resolve_name(str(target))
    except (ImportError, AttributeError, ValueError) as error:
        raise SettingError(
            place,
            found=f"{target}, of which something cannot be imported ({_said(error)})",
            expected="the full name of a class or function",
            remedy=_missing_package(error)
            or "Install its package, or add the folder it is in to PYTHONPATH.",
        ) from error


def _said(error: BaseException) -> str:
    """The first line of an error, and where it was raised: own networks fail in their own words."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename != __file__]
    first_line = str(error).strip().partition("\n")[0]
    place = f", {Path(frames[-1].filename).name} line {frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {first_line}{place}"


def _missing_package(error: BaseException | None) -> str:
    """How to install the package that is missing; empty if none is."""
    while error is not None and not (isinstance(error, ModuleNotFoundError) and error.name):
        error = error.__cause__ or error.__context__
    if error is None:
        return ""
    package = str(error.name).partition(".")[0]
    if package in _EXTRAS:
        return f"Run: pip install 'tangent-train[{_EXTRAS[package]}]'"
    return f"Install {package}, or add the folder it is in to PYTHONPATH."
