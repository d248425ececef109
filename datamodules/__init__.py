"""Data sets as Lightning data modules, a folder each.

`core` holds the common parts (data modules of panoramas and photos, samples, transforms, the
prepared store, checks); `images` reads and writes image files.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from datamodules.cityscapes.photos import Cityscapes as Cityscapes
    from datamodules.core.panorama_pairs import ImagePairs as ImagePairs
    from datamodules.densepass.panoramas import DensePASS as DensePASS
    from datamodules.folder.labeled import FolderPanoramas as FolderPanoramas
    from datamodules.folder.labeled import FolderPhotos as FolderPhotos
    from datamodules.matterport360.panoramas import Matterport360 as Matterport360
    from datamodules.modelnet40.datamodule import ModelNet40 as ModelNet40
    from datamodules.stanford2d3ds.pairs import StanfordPairs as StanfordPairs
    from datamodules.stanford2d3ds.panoramas import Stanford2D3DS as Stanford2D3DS
    from datamodules.stanford2d3ds.panoramas import (
        Stanford2D3DSPerspective as Stanford2D3DSPerspective,
    )
    from datamodules.structured3d.rooms import Structured3D as Structured3D
    from datamodules.structured3d.rooms import Structured3DPerspective as Structured3DPerspective
    from datamodules.synpass.panoramas import SynPASS as SynPASS
    from datamodules.synthia.omnisynthia import OmniSynthia as OmniSynthia
    from datamodules.synthia.omnisynthia import SynthiaPerspective as SynthiaPerspective
    from datamodules.synthrooms.datamodule import SynthRooms as SynthRooms
    from datamodules.synthrooms.datamodule import SynthRoomsPairs as SynthRoomsPairs
    from datamodules.synthrooms.datamodule import SynthRoomsPerspective as SynthRoomsPerspective
    from datamodules.synthshapes.datamodule import SynthShapes as SynthShapes
    from datamodules.zind.pairs import ZindPairs as ZindPairs
    from datamodules.zind.panoramas import Zind as Zind

_CLASSES = {
    "cityscapes.photos": ("Cityscapes",),
    "core.panorama_pairs": ("ImagePairs",),
    "densepass.panoramas": ("DensePASS",),
    "folder.labeled": ("FolderPanoramas", "FolderPhotos"),
    "matterport360.panoramas": ("Matterport360",),
    "modelnet40.datamodule": ("ModelNet40",),
    "stanford2d3ds.pairs": ("StanfordPairs",),
    "stanford2d3ds.panoramas": ("Stanford2D3DS", "Stanford2D3DSPerspective"),
    "structured3d.rooms": ("Structured3D", "Structured3DPerspective"),
    "synpass.panoramas": ("SynPASS",),
    "synthia.omnisynthia": ("OmniSynthia", "SynthiaPerspective"),
    "synthrooms.datamodule": ("SynthRooms", "SynthRoomsPairs", "SynthRoomsPerspective"),
    "synthshapes.datamodule": ("SynthShapes",),
    "zind.pairs": ("ZindPairs",),
    "zind.panoramas": ("Zind",),
}
_MODULES = {name: f"{__name__}.{file}" for file, names in _CLASSES.items() for name in names}

_GENERATED = ("synthrooms", "synthshapes")

__all__ = list(_MODULES)


def is_read(target: str) -> bool:
    """True for a data set of this package that does not generate its files: its root exists."""
    package, _, name = target.rpartition(".")
    file = _MODULES.get(name, "") if package == __name__ else ""
    return bool(file) and file.split(".")[1] not in _GENERATED


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def __getattr__(name: str) -> Any:
    # On demand: the processes that generate rooms need neither torch nor lightning.
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
