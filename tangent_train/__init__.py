"""Train and evaluate ordinary networks on 360° panoramas through tangent images.

The names below are imported when they are first used, so that ``import tangent_train`` is fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tangent_train.imports import check_own_packages

if TYPE_CHECKING:
    __version__: str
    from tangent_train.geometry import RingGrid, TangentGrid
    from tangent_train.inference.api import apply, load
    from tangent_train.rendering import (
        equirect_to_tangent,
        perspective,
        tangent_to_equirect,
        tangent_to_labels,
    )

__all__ = [
    "RingGrid",
    "TangentGrid",
    "__version__",
    "apply",
    "equirect_to_tangent",
    "load",
    "perspective",
    "tangent_to_equirect",
    "tangent_to_labels",
]

check_own_packages()

_HOMES = {
    "RingGrid": "geometry",
    "TangentGrid": "geometry",
    "apply": "inference.api",
    "load": "inference.api",
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("tangent-train")
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"tangent_train.{_HOMES.get(name, 'rendering')}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
