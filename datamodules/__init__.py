"""Data sets as Lightning data modules.

`segmentation_module`, `sources`, `samples` and `sampling` serve any labelled images, `panoramas`
and `panorama_module` panoramas, `photos` and `photo_module` photos. A data set adds modules that
find and read its files, like `stanford2d3ds` and `stanford_perspective`. Shapes as spheres are
`modelnet40`, with `shape_files`, `off_files`, `mesh_spheres`, `sphere_store` and `shape_samples`;
`split_module` is what all data modules share.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from datamodules.folder_panoramas import FolderPanoramas
    from datamodules.image_pairs import ImagePairs
    from datamodules.modelnet40 import ModelNet40
    from datamodules.omnisynthia import OmniSynthia
    from datamodules.panoramas import Panorama
    from datamodules.photos import Photo
    from datamodules.samples import EvaluationSample, Normalization, TrainingSample, normalize
    from datamodules.sampling import EpochSampler, sample_rng
    from datamodules.shape_samples import ShapeSample
    from datamodules.stanford2d3ds import Stanford2D3DS
    from datamodules.stanford_pairs import StanfordPairs
    from datamodules.stanford_perspective import Stanford2D3DSPerspective
    from datamodules.synthia_perspective import SynthiaPerspective
    from datamodules.synthrooms.datamodule import SynthRooms, SynthRoomsPerspective
    from datamodules.synthrooms.pairs import SynthRoomsPairs
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

_MODULES = (
    "folder_panoramas",
    "image_pairs",
    "modelnet40",
    "omnisynthia",
    "panoramas",
    "photos",
    "samples",
    "sampling",
    "shape_samples",
    "stanford2d3ds",
    "stanford_pairs",
    "stanford_perspective",
    "synthia_perspective",
    "synthrooms.datamodule",
    "synthrooms.pairs",
    "synthshapes.datamodule",
)


def __getattr__(name: str) -> Any:
    # On demand: the processes that make rooms need neither torch nor lightning.
    if name in __all__:
        for module in map(import_module, (f"datamodules.{module}" for module in _MODULES)):
            if name in module.__dict__.get("__all__", ()):
                return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
