"""Data sets as Lightning data modules.

`segmentation_module`, `sources`, `samples` and `sampling` serve any labelled images, `panoramas`
and `panorama_module` panoramas, `photos` and `photo_module` photos. A data set adds modules that
find and read its files, like `stanford2d3ds` and `stanford_perspective`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from datamodules.folder_panoramas import FolderPanoramas
    from datamodules.omnisynthia import OmniSynthia
    from datamodules.panoramas import Panorama
    from datamodules.photos import Photo
    from datamodules.samples import EvaluationSample, Normalization, TrainingSample, normalize
    from datamodules.sampling import EpochSampler, sample_rng
    from datamodules.stanford2d3ds import Stanford2D3DS
    from datamodules.stanford_perspective import Stanford2D3DSPerspective
    from datamodules.synthia_perspective import SynthiaPerspective
    from datamodules.synthrooms.datamodule import SynthRooms, SynthRoomsPerspective

__all__ = [
    "EpochSampler",
    "EvaluationSample",
    "FolderPanoramas",
    "Normalization",
    "OmniSynthia",
    "Panorama",
    "Photo",
    "Stanford2D3DS",
    "Stanford2D3DSPerspective",
    "SynthRooms",
    "SynthRoomsPerspective",
    "SynthiaPerspective",
    "TrainingSample",
    "normalize",
    "sample_rng",
]

_MODULES = (
    "folder_panoramas",
    "omnisynthia",
    "panoramas",
    "photos",
    "samples",
    "sampling",
    "stanford2d3ds",
    "stanford_perspective",
    "synthia_perspective",
    "synthrooms.datamodule",
)


def __getattr__(name: str) -> Any:
    # On demand: the processes that make rooms need neither torch nor lightning.
    if name in __all__:
        for module in map(import_module, (f"datamodules.{module}" for module in _MODULES)):
            if name in module.__dict__.get("__all__", ()):
                return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
