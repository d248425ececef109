"""Data sets as Lightning data modules, a folder each.

`core` is what they share (the data modules of panoramas and of photos, samples, transforms, the
prepared store, checks), `images` reads and writes image files.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from datamodules.core.inputs import Normalization, normalize
    from datamodules.core.panorama_pairs import ImagePairs
    from datamodules.core.panoramas import Panorama
    from datamodules.core.photos import Photo
    from datamodules.core.samples import EvaluationSample, TrainingSample
    from datamodules.core.sampling import EpochSampler, sample_rng
    from datamodules.folder.panoramas import FolderPanoramas
    from datamodules.modelnet40.datamodule import ModelNet40
    from datamodules.modelnet40.shape_samples import ShapeSample
    from datamodules.stanford2d3ds.pairs import StanfordPairs
    from datamodules.stanford2d3ds.panoramas import Stanford2D3DS
    from datamodules.stanford2d3ds.perspective import Stanford2D3DSPerspective
    from datamodules.synthia.omnisynthia import OmniSynthia
    from datamodules.synthia.perspective import SynthiaPerspective
    from datamodules.synthrooms.datamodule import (
        SynthRooms,
        SynthRoomsPairs,
        SynthRoomsPerspective,
    )
    from datamodules.synthshapes.datamodule import SynthShapes

__all__ = [
    "EpochSampler",
    "EvaluationSample",
    "FolderPanoramas",
    "ImagePairs",
    "ModelNet40",
    "Normalization",
    "OmniSynthia",
    "Panorama",
    "Photo",
    "ShapeSample",
    "Stanford2D3DS",
    "Stanford2D3DSPerspective",
    "StanfordPairs",
    "SynthRooms",
    "SynthRoomsPairs",
    "SynthRoomsPerspective",
    "SynthShapes",
    "SynthiaPerspective",
    "TrainingSample",
    "normalize",
    "sample_rng",
]

_MODULES = {
    "EpochSampler": "datamodules.core.sampling",
    "EvaluationSample": "datamodules.core.samples",
    "FolderPanoramas": "datamodules.folder.panoramas",
    "ImagePairs": "datamodules.core.panorama_pairs",
    "ModelNet40": "datamodules.modelnet40.datamodule",
    "Normalization": "datamodules.core.inputs",
    "OmniSynthia": "datamodules.synthia.omnisynthia",
    "Panorama": "datamodules.core.panoramas",
    "Photo": "datamodules.core.photos",
    "ShapeSample": "datamodules.modelnet40.shape_samples",
    "Stanford2D3DS": "datamodules.stanford2d3ds.panoramas",
    "Stanford2D3DSPerspective": "datamodules.stanford2d3ds.perspective",
    "StanfordPairs": "datamodules.stanford2d3ds.pairs",
    "SynthRooms": "datamodules.synthrooms.datamodule",
    "SynthRoomsPairs": "datamodules.synthrooms.datamodule",
    "SynthRoomsPerspective": "datamodules.synthrooms.datamodule",
    "SynthShapes": "datamodules.synthshapes.datamodule",
    "SynthiaPerspective": "datamodules.synthia.perspective",
    "TrainingSample": "datamodules.core.samples",
    "normalize": "datamodules.core.inputs",
    "sample_rng": "datamodules.core.sampling",
}


def __getattr__(name: str) -> Any:
    # On demand: the processes that make rooms need neither torch nor lightning.
    if name in _MODULES:
        return getattr(import_module(_MODULES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
