"""Objects made of settings, and which of them the settings inside a file may name.

A section of a config says by ``_target_`` what is made of it. In a config folder or on the command
line its owner wrote that, and any class or function may be named. Settings inside a file may be
anybody's. They are plain data: `accept` compares them with what classes say a file may set
(`registered`, at the class itself), and nothing in them is ever interpreted: no interpolations,
no positional arguments, no paths and no addresses. `make` is the only code that turns settings into
objects; for settings from files it finds registered objects and what the user trusts, by name.

This module imports nothing heavy: networks and data sets import it.
"""

from __future__ import annotations

import inspect
import re
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, TypeVar, get_args, get_origin

from tangent_train.errors import DataError, SettingError

__all__ = [
    "SIMPLE",
    "Accepted",
    "Local",
    "Object",
    "Text",
    "Weights",
    "accept",
    "check_fields",
    "check_plain",
    "make",
    "maker_of",
    "named_targets",
    "registered",
]


class Local:
    """A setting that only concerns a machine, never taken from a file: paths, compilers."""


class Object:
    """Another registered object."""


class Text:
    """Any text: what is only ever shown, as names of classes."""


class Weights:
    """Names trained weights: null in a file, whose own tensors are used."""


SIMPLE: Any = int | float | bool | str | None | list[int | float | bool | str | None]
"""A number, a word, or a list of these."""

_HOMES = (
    "datamodules",
    "models",
    "tangent_train.rendering",
    "tangent_train.tasks",
)
"""Packages whose public names files may give, where they are registered."""

_WORD = re.compile(r"[A-Za-z0-9][\w.+ -]{0,99}", re.ASCII)
"""A text in settings: no path, no address, no name of Hydra's, nothing to interpret."""

_DEEPEST = 12
_EXTRAS = {"segmentation_models_pytorch": "networks", "timm": "networks"}
"""Packages that an extra of this one installs."""

_settings: dict[Any, Mapping[str, Any]] = {}
_Registered = TypeVar("_Registered", bound=Callable[..., Any])


def registered(**kinds: Any) -> Callable[[_Registered], _Registered]:
    """Let settings in files name a class or function, with these settings and no others.

    Args:
        **kinds: By the name of a setting what it may be: ``int``, ``float``, ``bool``, ``str`` (a
            word), ``None``, `Literal`, ``list[…]``, ``dict[str, …]``, a union of these, or one of
            the kinds of this module. A subclass takes the settings of its bases as well.
    """

    def register(made: _Registered) -> _Registered:
        _settings[made] = kinds
        return made

    return register


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
    if isinstance(value, Mapping):
        inside = {
            name: check_plain(path, inner, f"{place}.{name}", depth + 1)
            for name, inner in value.items()
        }
        if all(type(name) is str for name in inside):
            return inside
    elif isinstance(value, list | tuple):
        return [check_plain(path, v, f"{place}.{k}", depth + 1) for k, v in enumerate(value)]
    elif value is None or type(value) in (bool, int, float, str):
        return value
    raise DataError(path, found=f"{place}={value!r}", expected=expected)


def make(
    settings: Mapping[str, Any],
    place: str,
    trust: Collection[str] | None = None,
    **given: Any,
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
    arguments = {
        name: _made(value, f"{place}.{name}", trust)
        for name, value in settings.items()
        if name not in ("_target_", "_partial_")
    } | given
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
    found = _imported(target, place) if trust is None else _find(target, trust)[0]
    if found is None:
        raise SettingError(f"{place}._target_", found=target, expected="a registered name")
    return found


def named_targets(settings: Any) -> set[str]:
    """All that settings name as ``_target_``."""
    return {str(value) for place, value in _leaves(settings, ()) if place[-1:] == ("_target_",)}


def _leaves(value: Any, place: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _leaves(inner, (*place, str(name)))
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _leaves(inner, place)
    else:
        yield place, value


def _made(value: Any, place: str, trust: Collection[str] | None) -> Any:
    if isinstance(value, Mapping):
        if "_target_" in value:
            return make(value, place, trust)
        return {name: _made(inner, f"{place}.{name}", trust) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_made(inner, f"{place}.{k}", trust) for k, inner in enumerate(value)]
    return value


class _Check:
    """The settings of one file."""

    def __init__(self, path: Path, trust: Collection[str], own: Collection[str]) -> None:
        self.path = path
        self.trust = trust
        self.own = own
        self.local: dict[str, Any] = {}

    def object(self, settings: Any, place: str) -> dict[str, Any]:
        if not isinstance(settings, Mapping):
            raise self._refused(place, repr(settings), "a section with a _target_")
        target = settings.get("_target_")
        kinds = self._kinds(f"{place}._target_", target)
        checked: dict[str, Any] = {"_target_": target}
        for name, value in settings.items():
            here = f"{place}.{name}"
            if name == "_target_":
                continue
            if self._is_own(here):
                checked[name] = value
            elif kinds is None:
                checked[name] = self._objects(value, here)
            elif name == "_partial_" and isinstance(value, bool):
                checked[name] = value
            else:
                kind = kinds.get(name) if isinstance(name, str) else None
                if kind is None:
                    known = ", ".join(kinds) or "none"
                    raise self._refused(here, repr(value), f"settings of {target} ({known})")
                self._add(checked, name, value, kind, here)
        no_weights = [name for name, kind in (kinds or {}).items() if kind is Weights]
        return checked | dict.fromkeys(no_weights)

    def _add(self, checked: dict[str, Any], name: str, value: Any, kind: Any, place: str) -> None:
        if kind is Weights:
            return
        if kind is Local:
            self.local[place] = value
        elif kind is Object:
            checked[name] = self.object(value, place)
        elif _fits(value, kind):
            checked[name] = value
        else:
            raise self._refused(place, repr(value), f"{shown(kind)} in a file")

    def _kinds(self, place: str, target: Any) -> Mapping[str, Any] | None:
        """By the name of a setting what it may be; None where the user trusts in whatever it is."""
        try:
            found, kinds = _find(target, self.trust)
        except SettingError as error:
            raise DataError(
                self.path,
                found=f"{place}={target}, of which something cannot be imported",
                expected="its package, as in training",
                remedy=error.remedy,
            ) from error
        if found is None and not self._is_own(place):
            raise DataError(
                self.path,
                found=f"{place}={target}, which would be called",
                expected="networks, data and tasks that are registered here",
                remedy=f"If you know it, and trust who made the file: trust={target}",
            )
        return kinds

    def _objects(self, value: Any, place: str) -> Any:
        """A plain value for what the user trusts, objects inside it checked."""
        if isinstance(value, Mapping):
            if "_target_" in value:
                return self.object(value, place)
            return {name: self._objects(inner, f"{place}.{name}") for name, inner in value.items()}
        if isinstance(value, list):
            return [self._objects(inner, f"{place}.{k}") for k, inner in enumerate(value)]
        return value

    def _is_own(self, place: str) -> bool:
        return any(place == own or place.startswith(f"{own}.") for own in self.own)

    def _refused(self, place: str, found: str, expected: str) -> DataError:
        return DataError(
            self.path,
            found=f"{place}={found}",
            expected=expected,
            remedy=f"On the command line {place}=… may be anything.",
        )


def _find(target: Any, trust: Collection[str]) -> tuple[Any, Mapping[str, Any] | None]:
    """A registered object with the kinds of its settings, or a trusted one; else None."""
    if not isinstance(target, str):
        return None, None
    module, _, name = target.rpartition(".")
    if module in _HOMES:
        home = import_module(module)
        made = getattr(home, name) if name in home.__all__ else None
        if made in _settings:
            bases = made.__mro__[::-1] if inspect.isclass(made) else (made,)
            return made, {k: v for base in bases for k, v in _settings.get(base, {}).items()}
    from tangent_train import libraries

    try:
        found = libraries.find(module, name)
    except ModuleNotFoundError as error:
        raise SettingError(
            target,
            found=f"no package {error.name}",
            expected="it, to make what a file names",
            remedy=_missing_package(error),
        ) from error
    if found is None and target in trust:
        return _imported(target, "trust"), None
    return found or (None, None)


def _imported(target: Any, place: str) -> Any:
    try:
        return resolve_name(str(target))
    except (ImportError, AttributeError, ValueError) as error:
        raise SettingError(
            f"{place}._target_",
            found=f"{target}, of which something cannot be imported ({_said(error)})",
            expected="the full name of a class or function",
            remedy=_missing_package(error)
            or "Install its package, or add the folder it is in to PYTHONPATH.",
        ) from error


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a kind, see `registered`."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is UnionType or (origin is not None and origin.__name__ == "Union"):
        return any(_fits(value, one) for one in arguments)
    if origin is Literal:
        return any(type(value) is type(one) and value == one for one in arguments)
    if origin is list:
        return isinstance(value, list | tuple) and all(_fits(v, arguments[0]) for v in value)
    if origin is dict:
        return isinstance(value, Mapping) and all(
            _fits(name, str) and _fits(inner, arguments[1]) for name, inner in value.items()
        )
    if kind is str:
        return isinstance(value, str) and _WORD.fullmatch(value) is not None
    if kind is Text:
        return isinstance(value, str)
    if kind is float:
        return type(value) in (int, float)
    if kind is dict:
        return isinstance(value, Mapping)
    return type(value) is (NoneType if kind is None else kind)


def shown(kind: Any) -> str:
    """A kind of setting in words.

    >>> shown(int | None), shown(list[float]), shown(Literal["yaw", "so3"]), shown(dict[str, int])
    ('int or null', 'a list of float', 'yaw or so3', 'a mapping of int')
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return " or ".join(map(str, arguments))
    if origin is list:
        return f"a list of {shown(arguments[0])}"
    if origin is dict:
        return f"a mapping of {shown(arguments[1])}"
    if arguments:
        return " or ".join(map(shown, arguments))
    names = {str: "a word", None: "null", NoneType: "null", Text: "a text", dict: "a mapping"}
    return names.get(kind) or str(kind.__name__)


def _said(error: BaseException) -> str:
    """What an error says and where: its first line, and the last line of code that is no library's.

    Own networks fail in their own words; a traceback would be of this module.
    """
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename != __file__]
    first_line = str(error).strip().partition("\n")[0]
    place = f", {Path(frames[-1].filename).name} line {frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {first_line}{place}"


def _missing_package(error: BaseException | None) -> str:
    """How to install the package that is missing; empty if none is."""
    while error is not None:
        if isinstance(error, ModuleNotFoundError) and error.name:
            package = error.name.partition(".")[0]
            if package in _EXTRAS:
                return f"Run: pip install 'tangent-train[{_EXTRAS[package]}]'"
            return f"Install {package}, or add the folder it is in to PYTHONPATH."
        error = error.__cause__ or error.__context__
    return ""
