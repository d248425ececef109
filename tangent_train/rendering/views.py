"""Ways to look at a panorama: which images, turned and mirrored how."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import PinholeGrid
from tangent_train.rendering.forward import Interpolation, equirect_to_tangent
from tangent_train.rendering.rotate import rotate_equirect

__all__ = ["EquirectViews", "PinholeViews", "Views"]

Image = NDArray[Any]


class Views(Protocol):
    """One way to look at one panorama or photo."""

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render it ``(H, W[, C])`` to images ``(n, h, w[, C])``, dtype kept."""
        ...


@dataclass(frozen=True)
class PinholeViews:
    """Pinhole images.

    Attributes:
        grid: All of them.
        faces: Those that are rendered; None for all.
        mirrored: Whether each image is mirrored left to right.
    """

    grid: PinholeGrid
    faces: NDArray[np.int64] | None = None
    mirrored: bool = False

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render a panorama ``(H, W[, C])`` to images ``(n, d, d[, C])``, dtype kept."""
        images = equirect_to_tangent(image, self.grid, self.faces, interpolation)
        return np.ascontiguousarray(images[:, :, ::-1]) if self.mirrored else images


@dataclass(frozen=True)
class EquirectViews:
    """The panorama itself.

    Attributes:
        rotation: ``(3, 3)`` rotation it is turned by; None for none.
        columns: Where a crop starts, as a share of the columns, and its width; None for no crop.
        mirrored: Whether it is mirrored left to right.
    """

    rotation: NDArray[np.float64] | None = None
    columns: tuple[float, int] | None = None
    mirrored: bool = False

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render a panorama ``(H, W[, C])`` to one image ``(1, H, w[, C])``, dtype kept."""
        if self.rotation is not None:
            image = rotate_equirect(image, self.rotation, interpolation)
        if self.columns is not None:
            start, width = self.columns
            first = int(start * image.shape[1])
            image = image.take(np.arange(first, first + width), axis=1, mode="wrap")
        if self.mirrored:
            image = image[:, ::-1]
        return np.ascontiguousarray(image[None])
