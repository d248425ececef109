"""Data sets as Lightning data modules.

`panoramas`, `samples`, `sampling` and `panorama_module` serve any data set of panoramas; a data
set adds one module that finds and reads its files, like `stanford2d3ds`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from datamodules.panoramas import Panorama
    from datamodules.samples import EvaluationSample, Normalization, TrainingSample, normalize
    from datamodules.sampling import EpochSampler, sample_rng
    from datamodules.stanford2d3ds import Stanford2D3DS
    from datamodules.synthrooms.datamodule import SynthRooms

__all__ = [
    "EpochSampler",
    "EvaluationSample",
    "Normalization",
    "Panorama",
    "Stanford2D3DS",
    "SynthRooms",
    "TrainingSample",
    "normalize",
    "sample_rng",
]

_MODULES = ("panoramas", "samples", "sampling", "stanford2d3ds", "synthrooms.datamodule")


def __getattr__(name: str) -> Any:
    # On demand: the processes that make rooms need neither torch nor lightning.
    if name in __all__:
        for module in map(import_module, (f"datamodules.{module}" for module in _MODULES)):
            if name in module.__dict__.get("__all__", ()):
                return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
