"""The images of another grid at another resolution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.pinhole_grid import PinholeGrid

__all__ = ["ResizedGrid"]


@dataclass(frozen=True, eq=False)
class ResizedGrid(PinholeGrid):
    """The images of another grid at another resolution; their outer edges agree.

    The output of a network that downsamples or upsamples tangent images lies on such a grid. With d
    pixels of pitch p there and d' here, the pitch here is p·d/d'.

    Args:
        original: The other grid.
        dim: Side d' in pixels, 2 or more.

    Raises:
        SettingError: The side is less than 2 pixels.
    """

    original: PinholeGrid
    dim: int

    def __post_init__(self) -> None:
        if self.dim < 2:
            raise SettingError("dim", found=self.dim, expected="2 or more")

    @property
    def rotation(self) -> NDArray[np.float64] | None:  # type: ignore[override]
        """That of the other grid."""
        return self.original.rotation

    @property
    def num_images(self) -> int:
        """N of the other grid."""
        return self.original.num_images

    @property
    def pitch(self) -> float:
        """Distance p·d/d' of neighbouring pixels on the image plane, in focal lengths."""
        return self.original.pitch * self.original.dim / self.dim

    @property
    def neighbors(self) -> NDArray[np.int32]:
        """Those of the other grid."""
        return self.original.neighbors

    @property
    def overlapping(self) -> bool:
        """Whether the images of the other grid overlap: their edges are these."""
        return self.original.overlapping

    def with_rotation(self, rotation: ArrayLike | None) -> Self:
        """The same images, rotated by this instead of their own.

        Raises:
            SettingError: The rotation is none.
        """
        return type(self)(self.original.with_rotation(rotation), self.dim)

    def _resting_axes(self) -> NDArray[np.float64]:
        return self.original._resting_axes()

    def _key(self) -> tuple[object, ...]:
        return self.original, self.dim
