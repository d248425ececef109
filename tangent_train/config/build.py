"""Build objects from the user's config.

Sections of a file of somebody else are built by `tangent_train.config.from_file`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial, wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar, get_type_hints

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from pydantic import ConfigDict, TypeAdapter, ValidationError
from typing_extensions import TypedDict

from tangent_train.errors import DataError, SettingError, wrong_setting

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_CHECKED = ("lightning.", "torch.optim.", "tangent_train.tasks.")
"""Modules whose annotations are checked, and whose errors are explained: those of trainers,
optimizers, schedules and tasks. Errors of other classes may be those of the user's own code."""


def build_from_config(section: Any, place: str, **given: Any) -> Any:
    """Build the object that a section of the user's config describes, with Hydra.

    Args:
        section: Section with ``_target_`` and its arguments by name, which may be sections too.
            ``_partial_: true`` returns a function that takes further arguments. Containers are
            plain ones (``_convert_: all``).
        place: Name of the section, e.g. ``data``, for messages.
        **given: Further arguments, passed on unchanged.

    Raises:
        SettingError: The class cannot be imported, or does not take its arguments. Other errors of
            a class are raised unchanged, except those of the libraries in `_CHECKED`.
    """
    if not isinstance(section, dict) or "_target_" not in section:
        raise SettingError(place, found=str(section), expected="a section with a _target_")
    target = str(section["_target_"])
    with _explained(place, target):
        make = instantiate({"_convert_": "all", **section, "_partial_": True})
        if target.startswith(_CHECKED):
            check_types(make.func, make.keywords, f"{place}.")
        make = partial(make.func, *make.args, **make.keywords | given)
        is_partial = section.get("_partial_") is True
        if is_partial:  # other arguments are refused now, not when it is called
            signature(make.func).bind_partial(*make.args, **make.keywords)
        return make if is_partial else make()


@contextmanager
def _explained(place: str, target: str) -> Iterator[None]:
    """Explain errors of a class or function that a section describes."""
    try:
        yield
    except Exception as error:
        cause = (error.__cause__ or error) if isinstance(error, InstantiationException) else error
        is_call = isinstance(cause, TypeError) and "argument" in str(cause)
        unfit = ImportError, InstantiationException, ValidationError
        is_explained = is_call or isinstance(cause, unfit) or target.startswith(_CHECKED)
        if not is_explained or isinstance(cause, DataError | SettingError):
            raise cause from None
        found = f"{target}, which cannot be built ({' '.join(str(cause).split())})"
        raise SettingError(place, found=found, expected="settings that it accepts") from error


def check_types(
    function: Callable[..., Any], values: Mapping[str, Any], prefix: str = ""
) -> dict[str, Any]:
    """Return arguments as the types that a function declares, other than None.

    Args:
        function: Function or class.
        values: Arguments by name.
        prefix: Prefix of the names in messages.

    Raises:
        SettingError: A value is of another type.
    """
    called: Any = function
    try:
        hints = get_type_hints(
            called.__init__ if isinstance(function, type) else called, include_extras=True
        )
    except NameError:  # names that are imported for type checkers only
        return {**values}
    kinds = {name: hints[name] for name, v in values.items() if name in hints and v is not None}
    make: Any = TypedDict
    arguments = make("arguments", kinds)
    arguments.__pydantic_config__ = ConfigDict(arbitrary_types_allowed=True)
    try:
        typed = TypeAdapter(arguments).validate_python({name: values[name] for name in kinds})
    except ValidationError as error:
        raise wrong_setting(error, prefix=prefix) from error
    return {**values, **typed}


def checks_types(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Decorate a function whose arguments by name are checked with `check_types`."""

    @wraps(function)
    def checked(*values: _Arguments.args, **named: _Arguments.kwargs) -> _Result:
        typed: Any = check_types(function, named)
        return function(*values, **typed)

    return checked


def filled(section: Any, known: Mapping[str, Any]) -> Any:
    """Return a section in which null settings, also of inner sections, have known values."""
    if not isinstance(section, Mapping):
        return section
    return {
        name: known.get(name) if value is None else filled(value, known)
        for name, value in section.items()
    }
