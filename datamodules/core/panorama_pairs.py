"""Pairs of panoramas of one place, with depth and pose where they are known."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from tangent_train.geometry import PanoramaPose

__all__ = ["PairedPanorama", "PanoramaPair", "PanoramaPairs"]


class PairedPanorama(NamedTuple):
    """One panorama of a pair.

    Attributes:
        name: Unique in the data set: the same panorama in another pair has the same name.
        rgb: ``(H, W, 3)`` uint8.
        distance_m: ``(H, W)`` float32 metres from the centre, NaN where missing; or None.
        pose: Where it was taken; or None.
        file: The image it was read from; or None.
    """

    name: str
    rgb: NDArray[np.uint8]
    distance_m: NDArray[np.float32] | None = None
    pose: PanoramaPose | None = None
    file: Path | None = None


class PanoramaPair(NamedTuple):
    """Two panoramas that show the same place.

    Attributes:
        name: Unique among the pairs.
        split: Which part of the data set it belongs to, where that is given.
        left: One of them.
        right: The other.
    """

    name: str
    split: str | None
    left: PairedPanorama
    right: PairedPanorama


class PanoramaPairs(ABC):
    """Pairs to read one by one."""

    def make_files(self) -> None:  # noqa: B027, one that has all its files makes none
        """Make what is not there yet; called before anything else."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of pairs."""

    @abstractmethod
    def name(self, index: int) -> str:
        """Name of a pair; see `PanoramaPair`."""

    @abstractmethod
    def read(self, index: int) -> PanoramaPair:
        """Read a pair.

        Raises:
            DataError: A file cannot be used.
        """
