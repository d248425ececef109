"""Build networks and representations that a file describes.

Any file may come from a stranger. Three rules make building safe: only networks and representations
of the packages below are built (and those that the user trusts); arguments are plain values, and
texts are words, never paths or addresses; arguments that name weights or checkpoints are null,
because the file holds the tensors.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from tangent_train.errors import DataError
from tangent_train.imports import offline

_PACKAGES = ("models", "segmentation_models_pytorch", "timm", "torch.nn", "torchvision.models")
"""Packages whose subclasses of `torch.nn.Module` a file may name."""

_VIEWS = "tangent_train.rendering.representations"
"""Package whose classes a file may name."""

_FUNCTIONS = (
    *("models.pretrained.widen_stem", "timm.models._factory.create_model"),
    *("models.mapped.face_neighbors", "models.mapped.gnomonic_points"),
    *("models.mapped.hexagonal_rings", "models.mapped.mapped_samples"),
    *("models.mapped.mesh_operators", "models.distortion_aware.make_distortion_aware"),
)
"""Functions that a file may name, besides torchvision's functions that build networks."""

_OF_HYDRA = "_target_", "_partial_", "_convert_", "_recursive_"
_WORD = re.compile(r"([A-Za-z0-9][\w.+ -]*)?", re.ASCII)
_WEIGHTS = re.compile(
    "(encoder_|backbone_)?weights(_backbone|_path)?|(checkpoint|weights)(_path|_file)?"
    "|pretrained(_backbone|_cfg|_cfg_overlay|_path|_weights)?"
)
"""Arguments that name weights or checkpoints; `use_checkpoint` and `class_weights` do not."""


def build_from_file(section: Any, place: str, path: Path, trust: Collection[str] = ()) -> Any:
    """Build the network or representation that a section in a file describes.

    Args:
        section: Section with ``_target_`` and its arguments by name, which may be sections too.
        place: Name of the section, for messages.
        path: File, for messages.
        trust: Packages of the user whose classes and functions the file may name too.

    Raises:
        DataError: The section names something else, or has arguments that are not allowed, or its
            class does not accept them.
    """
    try:
        with offline():
            return _build(without_weights(section), place, tuple(trust))
    except Exception as error:
        # Other errors are those of the class, for arguments that it does not accept.
        found = f"{place} cannot be built ({type(error).__name__}: {error})"
        reason: Any = error if isinstance(error, DataError) else None
        reason = reason or DataError(path, found=found, expected="arguments that its class accepts")
        raise DataError(
            path, found=reason.found, expected=reason.expected, remedy=reason.remedy
        ) from error


def without_weights(section: Any) -> Any:
    """Return settings in which arguments that name weights or checkpoints are null."""
    if not isinstance(section, Mapping):
        return section
    return {
        name: None if _WEIGHTS.fullmatch(str(name)) else without_weights(value)
        for name, value in section.items()
    }


def classes_to_trust(section: Any) -> list[str]:
    """Return the classes in a section that only a user who trusts them can load from a file."""
    if not isinstance(section, Mapping):
        return []
    names = [name for value in section.values() for name in classes_to_trust(value)]
    if (target := section.get("_target_")) is not None:
        try:
            _allowed(target, "network")
        except DataError:
            names.append(target)
    return names


def _build(section: Any, place: str, trust: tuple[str, ...]) -> Any:
    target = section["_target_"]
    is_trusted = _is_inside(target, trust)
    function = resolve_name(target) if is_trusted else _allowed(target, place)

    def plain(value: Any, name: str) -> Any:
        if isinstance(value, Mapping):
            if "_target_" in value:
                return _build(value, name, trust)
            return {key: plain(inner, f"{name}.{key}") for key, inner in value.items()}
        if isinstance(value, list | tuple):
            return [plain(inner, name) for inner in value]
        is_text = isinstance(value, str) and (is_trusted or _WORD.fullmatch(value))
        if is_text or value is None or isinstance(value, bool | int | float):
            return value
        raise DataError(name, found=f"{name}={value!r}", expected="numbers and words")

    arguments = plain({key: section[key] for key in section if key not in _OF_HYDRA}, place)
    make = partial(function, **arguments)
    return make if section.get("_partial_") is True else make()


def _allowed(target: str, place: str) -> Any:
    """Return the class or function that a file names, if it may name it."""
    if _is_inside(target, (*_PACKAGES, "tangent_train.rendering")):
        named = resolve_name(target)
        # The name may lead to another module through an import there.
        module = getattr(named, "__module__", None) or ""
        if isinstance(named, type):
            from torch import nn

            packages = _PACKAGES if issubclass(named, nn.Module) else (_VIEWS,)
            if _is_inside(module, packages):
                return named
        elif f"{module}.{getattr(named, '__name__', '')}" in _FUNCTIONS or _is_builder(named):
            return named
    raise DataError(
        place,
        found=f"{place}._target_={target}, which would be called",
        expected=f"a network of {', '.join(_PACKAGES)}, or a representation",
        remedy=f"If you know this class, and trust the author of the file: trust={target}",
    )


def _is_builder(function: Any) -> bool:
    """Return True for a registered function of torchvision that builds a network."""
    from torchvision.models import get_model_builder, list_models

    name = getattr(function, "__name__", "")
    return name in list_models() and get_model_builder(name) is function


def _is_inside(name: str, packages: Collection[str]) -> bool:
    return any(name == package or name.startswith(f"{package}.") for package in packages)
