"""Images that see what others see, with other pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.pinhole_grid import PinholeGrid

__all__ = ["ResizedGrid"]


@dataclass(frozen=True, eq=False, init=False)
class ResizedGrid(PinholeGrid):
    """The images of another grid, cut into more or fewer pixels: their outer edges agree.

    What a network of a lower resolution gives for tangent images, or one that magnifies them, lies
    on such a grid. With d pixels of pitch p there and d' here, the pitch here is p·d/d'.

    Args:
        original: The other grid.
        dim: Side d' in pixels, 2 or more.

    Raises:
        SettingError: The side is less than 2 pixels.
    """

    original: PinholeGrid
    dim: int
    rotation: NDArray[np.float64] | None

    def __init__(self, original: PinholeGrid, dim: int) -> None:
        if dim < 2:
            raise SettingError("dim", found=dim, expected="2 or more")
        object.__setattr__(self, "original", original)
        object.__setattr__(self, "dim", dim)
        object.__setattr__(self, "rotation", original.rotation)

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
