"""What settings inside a file may name: networks, data and tasks, no other code.

Hydra calls whatever a ``_target_`` names. In a config folder or on a command line its owner wrote
it; a checkpoint may be anybody's, and ``_target_: os.system`` would be a command of theirs. So what
settings in files name is compared with lists, and all else has to be trusted by its full name.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

from tangent_train.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["check_stored", "named_targets", "read_settings", "without_resolvers"]

_KNOWN = {
    "datamodules": (
        "FolderPanoramas ModelNet40 OmniSynthia Stanford2D3DS Stanford2D3DSPerspective SynthRooms "
        "SynthRoomsPerspective SynthShapes SynthiaPerspective"
    ),
    "lightning": "Trainer",
    "lightning.pytorch": "Trainer",
    "models": (
        "AuxiliaryHead FCNResNet HexUNet MultiView ShapeClassifier SphereAttention SphereContext "
        "SphereRendering UNet widen_stem"
    ),
    "tangent_train.rendering": (
        "CubemapRepresentation EquirectRepresentation PerspectiveRepresentation "
        "TangentRepresentation"
    ),
    "tangent_train.tasks": "ClassificationTask SegmentationTask",
    "tangent_train.tasks.schedules": "WarmupCosineLR",
    "timm": "create_model",
}
"""By module, what may be called: it does nothing but what its settings say."""

_KINDS = {
    "segmentation_models_pytorch": ("torch.nn", "Module"),
    "torch.nn": ("torch.nn", "Module"),
    "torch.optim": ("torch.optim", "Optimizer"),
    "torch.optim.lr_scheduler": ("torch.optim.lr_scheduler", "LRScheduler"),
}
"""Modules whose classes of one kind may be made; their functions fetch, read and write files."""

_BUILDERS = ("torchvision.models", "torchvision.models.segmentation")
"""Modules whose registered makers of networks may be called."""

_FETCHING = ("segmentation_models_pytorch", "timm")
"""Packages where the name of a network can be an address."""

_FILES = ("checkpoint_path", "pretrained_cfg", "pretrained_cfg_overlay")
"""Settings of theirs that name files and addresses."""

_RESOLVER = re.compile(r"\$\{[^${}]*:")
_OWN_RESOLVER = re.compile(r"\$\{oc\.env:(MODELNET40|STANFORD2D3DS|SYNTHIA),[\w/.-]*\}")
"""Where the data sets lie, as the configs of this package ask for it."""


def check_stored(
    path: Path,
    settings: Any,
    trust: Collection[str] = (),
    overridden: Collection[str] = (),
) -> None:
    """Refuse settings from a file that would run or fetch what is not known to be harmless.

    Args:
        path: The file, for the message.
        settings: Its settings, or some sections of them, as plain values.
        trust: What the user trusts, as it is written in the file: ``my_networks.Hourglass``.
        overridden: Settings (``network._target_``) whose values in the file will not be used.

    Raises:
        DataError: There is such a setting; which, and how to allow it.
    """
    with _nesting(path):
        findings = list(_findings(settings, (), fetching=False))
    for place, value, kind in findings:
        if ".".join(place) not in overridden and str(value) not in trust:
            raise DataError(
                path,
                found=f"{'.'.join(place)}={value}, {kind}",
                expected="settings of networks, data and tasks that are known here",
                remedy=f"If you know it, and trust who made the file: trust={value}",
            )


def named_targets(settings: Any) -> set[str]:
    """All code that settings name."""
    return {str(value) for place, value in _leaves(settings, ()) if place[-1:] == ("_target_",)}


def read_settings(path: Path) -> Any:
    """Settings of a YAML file as plain values, references to each other resolved.

    Nothing else is looked up: ``${oc.env:HOME}`` stays what it is. Nor are aliases followed, by
    which a few lines can stand for more than fits into memory; runs write none.

    Args:
        path: The file.

    Raises:
        ValueError: There is an alias. Other errors are those of files, YAML and OmegaConf.
    """
    text = path.read_text(encoding="utf-8")
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
        raise ValueError("an alias, which runs do not write")
    written = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    return OmegaConf.to_container(OmegaConf.create(_quoted(written)), resolve=True)


def _quoted(settings: Any) -> Any:
    """Settings whose resolvers are plain text."""
    if isinstance(settings, Mapping):
        return {name: _quoted(value) for name, value in settings.items()}
    if _is_list(settings):
        return [_quoted(value) for value in settings]
    return settings.replace("${", r"\${") if _has_resolver(settings) else settings


def without_resolvers(path: Path, settings: Any, resolved: Any) -> Any:
    """Settings in which nothing is looked up but other settings.

    ``${oc.env:HOME}`` would put what is in the reader's environment into results that are handed
    on. What the run found there is taken instead.

    Args:
        path: The file, for the message.
        settings: As they were written.
        resolved: The same with all references resolved, from the same file.

    Raises:
        DataError: Settings are nested too deeply.
    """
    with _nesting(path):
        return _found_before(settings, resolved)


def _found_before(settings: Any, resolved: Any) -> Any:
    if isinstance(settings, Mapping):
        found = resolved if isinstance(resolved, Mapping) else {}
        return {name: _found_before(value, found.get(name)) for name, value in settings.items()}
    if _is_list(settings):
        found = resolved if _is_list(resolved) and len(resolved) == len(settings) else settings
        return [_found_before(*pair) for pair in zip(settings, found, strict=True)]
    return settings if resolved is None or not _has_resolver(settings) else resolved


@contextmanager
def _nesting(path: Path) -> Iterator[None]:
    try:
        yield
    except RecursionError as error:
        raise DataError(
            path, found="settings inside settings without end", expected="those of a run"
        ) from error


def _findings(
    value: Any, place: tuple[str, ...], *, fetching: bool
) -> Iterator[tuple[tuple[str, ...], Any, str]]:
    """What is not known to be harmless: where, what, and why."""
    if isinstance(value, Mapping):
        target = value.get("_target_")
        if target is not None:
            fetching = str(target).partition(".")[0] in _FETCHING
        for name, inner in value.items():
            here = (*place, str(name))
            reason = _refused(here, inner, fetching=fetching)
            if reason:
                yield here, inner, reason
            else:
                yield from _findings(inner, here, fetching=fetching)
    elif _is_list(value):
        for k, inner in enumerate(value):
            yield from _findings(inner, (*place, str(k)), fetching=fetching)
    elif _has_resolver(value):
        yield place, value, "which would be looked up outside of the settings"
    elif fetching and isinstance(value, str) and ":" in value:
        yield place, value, "an address to fetch things from"


def _refused(place: tuple[str, ...], value: Any, *, fetching: bool) -> str:
    """Why a setting is refused whatever is in it; empty if it is not."""
    if value is None:
        return ""
    if place[-1] == "_target_" and not _is_known(value):
        return "which would be called"
    if place[-2:] == ("compile", "options"):
        return "which can name programs to run"
    return "which would be read or fetched" if fetching and place[-1] in _FILES else ""


def _leaves(value: Any, place: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _leaves(inner, (*place, str(name)))
    elif _is_list(value):
        for k, inner in enumerate(value):
            yield from _leaves(inner, (*place, str(k)))
    else:
        yield place, value


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def _has_resolver(value: Any) -> bool:
    looked_up = isinstance(value, str) and _RESOLVER.search(value) is not None
    return looked_up and _OWN_RESOLVER.fullmatch(value) is None


def _is_known(target: Any) -> bool:
    if not isinstance(target, str):
        return False
    module, _, name = target.rpartition(".")
    if name in _KNOWN.get(module, "").split():
        return True
    # An exact module and a plain name: "torch.nn.functional.warnings.sys" is a module as well.
    if not name.isidentifier() or name.startswith("_"):
        return False
    try:
        if module in _KINDS:
            parent, kind = _KINDS[module]
            found = getattr(import_module(module), name, None)
            return isinstance(found, type) and issubclass(
                found, getattr(import_module(parent), kind)
            )
        return module in _BUILDERS and _is_builder(module, name)
    except ModuleNotFoundError:
        return True  # which is said where it is made, with what to install


def _is_builder(module: str, name: str) -> bool:
    from torchvision.models import get_model_builder, list_models

    maker = getattr(import_module(module), name, None)
    return name in list_models() and get_model_builder(name) is maker
