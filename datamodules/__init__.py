"""Data sets as Lightning data modules.

`panoramas`, `samples`, `sampling` and `panorama_module` serve any data set of panoramas; a data
set adds one module that finds and reads its files, like `stanford2d3ds`.
"""

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
