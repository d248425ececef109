"""Build objects from the user's config.

Sections of a file of somebody else are built by `tangent_train.config.from_file`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from inspect import signature
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from pydantic import ValidationError

from tangent_train.errors import SettingError


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
            a class are raised unchanged.
    """
    if not isinstance(section, dict) or "_target_" not in section:
        raise SettingError(place, found=str(section), expected="a section with a _target_")
    try:
        make = instantiate({"_convert_": "all", **section, "_partial_": True})
        make = partial(make.func, *make.args, **make.keywords | given)
        is_partial = section.get("_partial_") is True
        if is_partial:  # other arguments are refused now, not when it is called
            signature(make.func).bind_partial(*make.args, **make.keywords)
        return make if is_partial else make()
    except Exception as error:
        cause = (error.__cause__ or error) if isinstance(error, InstantiationException) else error
        is_call = isinstance(cause, TypeError) and "argument" in str(cause)
        unfit = ImportError, InstantiationException, ValidationError
        if not is_call and not isinstance(cause, unfit):
            raise cause from None
        found = f"{section['_target_']}, which cannot be built ({' '.join(str(cause).split())})"
        raise SettingError(place, found=found, expected="settings that it accepts") from error


def filled(section: Any, known: Mapping[str, Any]) -> Any:
    """Return a section in which null settings, also of inner sections, have known values."""
    if not isinstance(section, Mapping):
        return section
    return {
        name: known.get(name) if value is None else filled(value, known)
        for name, value in section.items()
    }
