"""Small data sets in the formats of the field's benchmarks, for tests of their experiments."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

from tests.conftest import fabricate
from tests.datamodules.cityscapes.street_format import (
    write_cityscapes,
    write_densepass,
    write_synpass,
)
from tests.datamodules.matterport360.matterport_format import write_matterport
from tests.datamodules.structured3d.structured3d_format import write_structured3d


class World(NamedTuple):
    """A small data set.

    Attributes:
        write: Writes the files into a new folder and returns it.
        small: Settings of panoramas that let a run take a second, with which the files fit.
    """

    write: Callable[[Path], Path]
    small: tuple[str, ...] = ("level=4", "representation.erp_height=32")


WORLDS: Mapping[str, World] = {
    "Cityscapes": World(write_cityscapes),
    "DensePASS": World(
        partial(write_densepass, names=(1,)), ("level=6", "photos.representation.dim=[16,32]")
    ),
    "Matterport360": World(write_matterport),
    "Stanford2D3DS": World(fabricate),
    "Stanford2D3DSPerspective": World(partial(fabricate, photos=2)),
    "Structured3D": World(write_structured3d),
    "SynPASS": World(write_synpass),
}
"""By the class of the data set, the last part of ``data._target_``."""
