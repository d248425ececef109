"""Build objects from settings; register the classes and functions that files may name.

``_target_`` of a config section names the class or function. Config folders and the command line
belong to the user: Hydra builds their sections, and they may name any class. Files are untrusted
plain data: they may name registered classes, with arguments that the annotations allow, and are not
interpreted: no interpolations, positional arguments, paths or URLs. `build_from_config` is the only
code that builds objects from settings.

This module imports nothing heavy, because networks and data sets import it.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from types import NoneType, UnionType
from typing import Any, Literal, NoReturn, Union, get_args, get_origin, get_type_hints

from tangent_train.errors import DataError, SettingError, printable
from tangent_train.imports import offline

_HOMES = (
    "datamodules",
    "models",
    "tangent_train.rendering",
    "tangent_train.tasks",
    "tangent_train.heads",
)
"""Packages whose registered public names may be in files."""

_WORD = re.compile(r"([A-Za-z0-9][\w.+ -]{0,99})?", re.ASCII)
"""Text that is allowed as an argument in a file: not a path, address or code."""

_DEEPEST = 12
_PLAIN = (bool, int, float, str, NoneType)
_HYDRA = {
    "_target_": str,
    "_args_": None,
    "_convert_": Literal["none", "partial", "object", "all"],
    "_partial_": None,
    "_recursive_": bool,
}
"""Names in a section that are not arguments, with the kinds of value that are allowed in files."""

_CALLED_LATER = ("mixer", "optimizer", "scheduler", "table")
"""Sections of a file that may be ``_partial_``: functions that take further arguments later."""


class Text:
    """Kind of value: text that is only displayed, such as class names."""


class Weights:
    """Kind of argument: pretrained weights; null in a file, which contains the tensors."""


class _Object:
    """Kind of argument: an object, built from an inner section."""


@dataclass(frozen=True)
class SettingsFile:
    """The file that settings come from, with exceptions that the user typed.

    Attributes:
        path: File, for messages.
        trust: Full names of classes and functions that the file may name besides the registered
            ones; their arguments may be any plain values.
        user_settings: Settings (``data.fold``) that, with all settings below them, come from the
            user instead of the file.
    """

    path: Path
    trust: Collection[str] = ()
    user_settings: Collection[str] = ()

    def gave(self, place: str) -> bool:
        """Return True if the value of a setting comes from the file, False if from the user."""
        return not any(f"{place}.".startswith(f"{name}.") for name in self.user_settings)

    def refused(self, place: str, value: Any, expected: str) -> DataError:
        """Return the error for an invalid value of the file."""
        remedy = f"To use it, type {place}=…."
        return DataError(self.path, found=f"{place}={value!r}", expected=expected, remedy=remedy)


def build_from_config(
    settings: Any, place: str, file: SettingsFile | None = None, **given: Any
) -> Any:
    """Build the object that a section of a config describes.

    The user's sections are built by `hydra.utils.instantiate` with all of its conventions, and
    ``_convert_: all`` as the default. A section that comes from a file, even in part, is built here
    without interpretation.

    Args:
        settings: Section with ``_target_`` and its arguments by name, which may be sections too.
            ``_partial_: true`` returns a function that takes further arguments.
        place: Name of the section, e.g. ``data``, for messages.
        file: File of the settings; None for the user's settings, which may name any class.
        **given: Further arguments, passed on unchanged.

    Raises:
        SettingError: The class or function cannot be imported, gets text for a number, or does not
            take its arguments. Other errors of user-defined classes are raised unchanged.
        DataError: The file contains forbidden or invalid settings.
    """
    maker, kinds = _resolve(settings, place, file)
    weights = [name for name, kind in kinds.items() if kind is Weights and file is not None]
    section = dict.fromkeys(weights) | dict(settings)
    source = file if file is not None and file.gave(place) else None
    try:
        if source is None:
            return _instantiated(section, place, given)
        values = {
            name: _argument(
                value, f"{place}.{name}", source, kinds.get(name, kinds.get("**")), kinds
            )
            for name, value in section.items()
            if name != "_target_"
        }
        arguments = {name: value for name, value in values.items() if name not in _HYDRA}
        _check_taken(maker, settings["_target_"], arguments, place, source)
        make = partial(maker, *values.get("_args_", ()), **arguments | given)
        with offline():
            return make if values.get("_partial_") else make()
    except (DataError, SettingError):
        raise
    except Exception as error:
        _refuse(error, section, place, source)


def _instantiated(section: Mapping[str, Any], place: str, given: Mapping[str, Any]) -> Any:
    """Build a section of the user's config as Hydra does."""
    from hydra.utils import instantiate

    check_arguments(section, place)
    # References of the config have been resolved; Hydra would resolve their values again.
    plain = {"_convert_": "all", **section, "_partial_": True}
    plain = without_interpolation(without_interpolation(plain))
    try:
        make = instantiate(plain)
    except Exception as error:
        inside = re.search(r"^full_key: (\S+)$", str(error), re.MULTILINE)
        name = f"{place}.{inside[1]}" if inside else place
        places = {re.sub(r"\.(?=\d)", "", at): at for _, at in _sections(section, place)}
        at = places.get(re.sub(r"[][]", "", name), place)  # Hydra writes items as x[0] or x0
        sections = {at: inner for inner, at in _sections(section, place)}
        _refuse(error.__cause__ or error, sections[at], at, None)
    make = partial(make.func, *make.args, **make.keywords | given)
    return make if section.get("_partial_") else make()


def check_arguments(section: Any, place: str) -> None:
    """Refuse arguments that the classes in a section of the user's config do not take.

    Args:
        section: Section to check, or None.
        place: Name of the section, for messages.

    Raises:
        SettingError: A class cannot be imported, or gets an unknown argument or text for a number.
    """
    for inner, at in _sections(section, place):
        maker, kinds = _resolve(inner, at, None)
        arguments = [name for name in inner if name not in _HYDRA]
        for name in arguments:
            _check_whole(inner[name], f"{at}.{name}", kinds.get(name))
        _check_taken(maker, inner["_target_"], arguments, at, None)


def _sections(value: Any, place: str) -> Iterator[tuple[Mapping[str, Any], str]]:
    """Yield a section and the sections inside it that Hydra builds, with their names."""
    if isinstance(value, Mapping) and "_target_" in value:
        yield value, place
    inner: Iterable[tuple[Any, Any]] = enumerate(value) if isinstance(value, list) else ()
    if isinstance(value, Mapping) and value.get("_recursive_", True):
        inner = value.items()
    for name, one in inner:
        yield from _sections(one, f"{place}.{name}")


def _refuse(
    error: BaseException, section: Mapping[str, Any], place: str, source: SettingsFile | None
) -> NoReturn:
    """Raise an error of building an object, in one line unless a user-defined class raised it.

    A class that passes its arguments on to another one may raise an error about a setting.
    """
    if isinstance(error, DataError | SettingError):
        raise error
    name = section["_target_"]
    is_foreign = _find(name) is None and not name.startswith("lightning.")
    is_of_hydra = type(error).__module__.startswith(("hydra.", "omegaconf."))
    unknown = re.search(r"unexpected keyword argument '(\w+)'$", str(error))
    is_of_setting = is_of_hydra or (unknown is not None and unknown[1] in section)
    if source is None and not is_of_setting and (is_foreign or isinstance(error, OSError)):
        raise error
    reason = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
    found, expected = f"{name} cannot be made ({reason})", "settings that it accepts"
    if source is not None:
        raise DataError(source.path, found=f"{place}: {found}", expected=expected) from error
    raise SettingError(place, found=found, expected=expected) from error


def without_interpolation(value: Any) -> Any:
    """Escape plain values so that OmegaConf reads them literally."""
    if isinstance(value, Mapping):
        return {name: without_interpolation(inner) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [without_interpolation(inner) for inner in value]
    return re.sub(r"(\\*)\$\{", r"\1\1\\${", value) if isinstance(value, str) else value


def named_arguments(settings: Any) -> Any:
    """Return settings with named instead of positional arguments (``_args_``), as files need."""
    if isinstance(settings, list):
        return [named_arguments(value) for value in settings]
    if not isinstance(settings, Mapping):
        return settings
    named = {name: named_arguments(value) for name, value in settings.items()}
    if "_target_" in named and "_args_" in named:
        maker, positional = import_named(named["_target_"], ""), named["_args_"]
        with suppress(TypeError, ValueError):
            parameters = inspect.signature(maker).parameters.values()
            names = [one.name for one in parameters if one.kind is one.POSITIONAL_OR_KEYWORD]
            named |= dict(zip(names[: len(positional)], positional, strict=True))
            del named["_args_"]
    return named


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a question with the known name most similar to a misspelled one, or "".

    >>> nearest("levl", ["seed", "level"])
    'Is level meant? '
    """
    near = get_close_matches(name, known, 1)
    return f"Is {near[0]} meant? " if near else ""


def _check_taken(
    maker: Any, target: str, arguments: Collection[str], place: str, file: SettingsFile | None
) -> None:
    """Refuse arguments that a class or function does not have, e.g. those of another one."""
    try:
        known: Any = inspect.signature(maker).parameters
    except (TypeError, ValueError):  # not written in Python
        return
    if any(one.kind is one.VAR_KEYWORD for one in known.values()):
        if _find(f"{maker.__module__}.{maker.__name__}") is None:
            return
        known = _kinds(maker)
    unknown = [name for name in arguments if name not in known]
    if not unknown:
        return
    name = f"{place}.{unknown[0]}"
    found, expected = f"{', '.join(unknown)} for {target}", f"settings of {', '.join(known)}"
    if file is not None and file.gave(name):
        raise DataError(file.path, found=f"{place}: {found}", expected=expected)
    remedy = "Remove it."
    if not _is_typed(name):
        removed = " ".join(f"~{place}.{name}" for name in unknown)
        remedy = f"Remove {'it' if len(unknown) == 1 else 'them'} with {removed}, "
        remedy += f"or choose an option of {place}=."
        if place == "data":
            remedy += " An experiment is for its data set; recipe=small is for other panoramas."
    remedy = nearest(unknown[0], known) + remedy
    raise SettingError(place, found=found, expected=expected, remedy=remedy)


def _is_typed(name: str) -> bool:
    """Return True if the user added a setting on the command line."""
    from hydra.core.hydra_config import HydraConfig

    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else ()
    return any(text.lstrip("+").startswith(f"{name}=") for text in overrides)


def resolve_target(settings: Any, place: str, file: SettingsFile | None = None) -> Any:
    """Return the class or function that a section names; see `build_from_config`."""
    return _resolve(settings, place, file)[0]


def import_named(target: Any, place: str) -> Any:
    """Import an object by its full name.

    Raises:
        SettingError: The object cannot be imported.
    """
    try:
        return resolve_name(str(target))
    except (ImportError, AttributeError, ValueError) as error:
        remedy = "Install its package, or add its folder to PYTHONPATH."
        if str(target).partition(".")[0] in sys.modules:
            remedy = "Correct the name."
        raise SettingError(
            f"{place}._target_",
            found=f"{target}, which cannot be imported ({error})",
            expected="the full name of a class or function",
            remedy=remedy,
        ) from error


def unregistered(settings: Any) -> tuple[str, ...]:
    """Return the classes in a section, and in sections inside it, that files may not name.

    Args:
        settings: Section, whose classes exist.
    """
    if not isinstance(settings, Mapping):
        return ()
    target = settings.get("_target_")
    names = [target] if target is not None and _find(target) is None else []
    names += [name for value in settings.values() for name in unregistered(value)]
    return tuple(dict.fromkeys(names))


def check_fields(
    path: Path, content: Any, kinds: Mapping[str, Any], expected: str, where: str = ""
) -> dict[str, Any]:
    """Return the fields of a mapping in a file, each of its kind.

    Args:
        path: File, for the message.
        content: Content of the file.
        kinds: Kind of each field; a union with None if the field may be missing.
        expected: Expected file, for the message.
        where: Place in the file, for the message.

    Returns:
        Values of the fields; None for missing ones.

    Raises:
        DataError: The content is not a mapping, or a field is missing or of another kind.
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
    """Return the plain values of a file: numbers, texts, lists and mappings of these.

    Names in mappings are texts without a dot, so that ``a.b`` is always the value ``b`` in the
    mapping ``a``.

    Args:
        path: File, for the message.
        value: Values to check.
        place: Place of the values in the file, for the message.
        depth: Number of mappings and lists around the values.

    Raises:
        DataError: There are other values or names, or they are nested too deeply.
    """
    expected = f"plain values, at most {_DEEPEST} inside each other"
    if depth > _DEEPEST:
        raise DataError(path, found=f"more of them in {place[:80]}…", expected=expected)
    if isinstance(value, Mapping):
        for name in value:
            if not is_text(name) or "." in name:
                found, names = f"the name {name!r} in {place}", "names of settings, without dots"
                raise DataError(path, found=found, expected=names)
        return {n: check_plain(path, v, f"{place}.{n}", depth + 1) for n, v in value.items()}
    if isinstance(value, list | tuple):
        return [check_plain(path, v, f"{place}.{k}", depth + 1) for k, v in enumerate(value)]
    plain = value is None or type(value) in (bool, int, float)
    if plain or (type(value) is str and printable(value) == value):
        return value
    raise DataError(path, found=f"{place}={value!r}", expected=expected)


def _resolve(settings: Any, place: str, file: SettingsFile | None) -> tuple[Any, Mapping[str, Any]]:
    """Return the class or function of a section, with the kinds of its arguments in a file."""
    target = settings.get("_target_") if isinstance(settings, Mapping) else None
    if not isinstance(target, str):
        expected = "a section with a _target_"
        if file is not None:
            raise file.refused(place, settings, expected)
        raise SettingError(place, found=f"{settings}", expected=expected)
    found = _find(str(target))
    if found is not None:
        return found
    if file is None or target in file.trust or not file.gave(f"{place}._target_"):
        return import_named(target, place), {"**": Any}
    raise DataError(
        file.path,
        found=f"{place}._target_={target}, which would be called",
        expected="networks, data and tasks that are registered here",
        remedy=f"If you know this class, and trust the author of the file: trust={target}",
    )


def _argument(
    value: Any, place: str, file: SettingsFile, kind: Any, kinds: Collection[str] = ()
) -> Any:
    """Check a value from settings that come from a file at least in part, and build its objects."""
    if file.gave(place):
        _check_argument(value, place, file, kind, kinds)
    else:
        _check_whole(value, place, kind)
    if isinstance(value, Mapping) and "_target_" in value:
        return build_from_config(value, place, file)
    if isinstance(value, Mapping):
        return {name: _argument(v, f"{place}.{name}", file, Any) for name, v in value.items()}
    if isinstance(value, list):
        return [_argument(v, f"{place}.{k}", file, Any) for k, v in enumerate(value)]
    return value


def _check_argument(
    value: Any, place: str, file: SettingsFile, kind: Any, kinds: Collection[str]
) -> None:
    section, _, name = place.rpartition(".")
    if name in ("_convert_", "_recursive_"):  # without effect here
        kind = _HYDRA[name]
    if name == "_partial_" and section.rpartition(".")[2] in _CALLED_LATER:
        kind = bool
    if kind is None:
        raise file.refused(place, value, f"one of its settings ({', '.join(kinds)})")
    if kind is _Object and isinstance(value, Mapping) and "_target_" in value:
        return  # `build_from_config` checks it
    if value is not None and kind is not Any and not _fits(value, kind):
        raise file.refused(place, value, f"{inspect.formatannotation(kind)} in a file")


def _check_whole(value: Any, place: str, kind: Any) -> None:
    """Refuse text for a whole number or boolean, also for an optional one."""
    is_whole = set() < set(get_args(kind) or (kind,)) - {NoneType} <= {bool, int}
    if is_whole and isinstance(value, str):
        raise SettingError(place, found=value, expected=inspect.formatannotation(kind))


def _find(target: str) -> tuple[Any, Mapping[str, Any]] | None:
    """Return a class or function that all files may name, with the kinds of its arguments."""
    module, _, name = target.rpartition(".")
    if module in _HOMES:
        home = import_module(module)
        named = getattr(home, name) if name in home.__all__ else None
        return (named, _kinds(named)) if named is not None else None
    from tangent_train.config import libraries

    return libraries.find(module, name)


def _kinds(target: Any) -> dict[str, Any]:
    """Return the kind of value that a file may contain for each argument, also for base classes."""
    if is_dataclass(target):  # annotations are resolved in the module that declares a field
        hints = get_type_hints(target)
        return {one.name: _kind(hints[one.name]) for one in fields(target) if one.init}
    kinds: dict[str, Any] = {}
    for base in inspect.getmro(target) if inspect.isclass(target) else (target,):
        function = vars(base).get("__init__") if inspect.isclass(base) else base
        if function is None:
            continue
        hints = get_type_hints(function)
        arguments = inspect.signature(function).parameters.values()
        inherited = {a.name: _kind(hints[a.name]) for a in arguments if a.name in hints}
        kinds = {**{n: k for n, k in inherited.items() if n != "settings"}, **kinds}
        if not any(a.kind is a.VAR_KEYWORD for a in arguments):
            break
    return kinds


def _kind(hint: Any) -> Any:
    members = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if any(m in (Any, object) or Any in get_args(m) for m in members):
        return NoneType
    if Path in members:  # text would be a path
        members = tuple(m for m in members if m not in (Path, str)) or (NoneType,)
    plain = [member for member in members if _is_plain(member)]
    return Union[tuple(plain)] if set(plain) - {NoneType} else _Object  # noqa: UP007 - of a list


def _is_plain(hint: Any) -> bool:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType, Sequence, Mapping, list, dict):
        return all(map(_is_plain, arguments))
    return hint in _PLAIN or origin is Literal


def is_text(value: Any) -> bool:
    """Return True for one line of text without control characters, such as a class name."""
    return isinstance(value, str) and "\n" not in value and printable(value) == value


def is_class_name(value: Any) -> bool:
    """Return True for a `Text` that can be written as UTF-8; names of files may not."""
    return is_text(value) and not any("\ud800" <= letter <= "\udfff" for letter in value)


def _fits(value: Any, kind: Any) -> bool:
    """Return True if a value is of a kind: a type of plain values, or `Text`."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, one) for one in arguments)
    if origin is Literal:
        return any(type(value) is type(one) and value == one for one in arguments)
    if origin in (Sequence, list):
        return isinstance(value, list | tuple) and all(_fits(v, arguments[0]) for v in value)
    if origin in (Mapping, dict):
        return isinstance(value, Mapping) and all(
            _fits(name, str) and _fits(inner, arguments[1]) for name, inner in value.items()
        )
    if kind is str:
        return isinstance(value, str) and _WORD.fullmatch(value) is not None
    if kind is Text:
        return is_text(value)
    if kind is dict:
        return isinstance(value, Mapping)
    return type(value) in (int, float) if kind is float else type(value) is kind
