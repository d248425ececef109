"""Ways to look at a panorama: which images, turned and mirrored how."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import PinholeGrid
from tangent_train.rendering.forward import Interpolation, equirect_to_tangent
from tangent_train.rendering.rotate import rotate_equirect

__all__ = ["NO_RAYS", "UNTURNED", "EquirectViews", "ManyViews", "PinholeViews", "Views"]

Image = NDArray[Any]

NO_RAYS: NDArray[np.float32] = np.empty((0, 3, 3), np.float32)
"""Of views that are no pinhole images of a sphere."""

UNTURNED: NDArray[np.float64] = np.eye(3)[None]
"""Rotations of views that nobody turned."""


class Views(Protocol):
    """One way to look at one panorama or photo."""

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render it ``(H, W[, C])`` to images ``(n, h, w[, C])``, dtype kept."""
        ...

    def rays(self) -> NDArray[np.float32]:
        """Where the images look, ``(n, 3, 3)``; `NO_RAYS` where that cannot be said so.

        Each matrix maps ``(x, y, 1)``, with x and y from −1 at the left and upper edge of an image
        to 1 at the opposite one, to a direction (of any length) on the sphere.
        """
        ...

    def rotations(self) -> NDArray[np.float64]:
        """Turns of the whole representation that they are of, ``(K, 3, 3)``: directions are R·d."""
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

    def rays(self) -> NDArray[np.float32]:
        """Camera axes, scaled to the images' edges; see `Views`."""
        grid = self.grid
        edge = grid.dim / 2 * grid.pitch
        axes = grid.world_from_camera[grid.face_indices(self.faces)]
        return (axes * (-edge if self.mirrored else edge, edge, 1)).astype(np.float32)

    def rotations(self) -> NDArray[np.float64]:
        """That of the grid."""
        return UNTURNED if self.grid.rotation is None else self.grid.rotation[None]


@dataclass(frozen=True)
class ManyViews:
    """The images of several views of the same panorama, one after the other.

    Attributes:
        parts: The views.
    """

    parts: tuple[PinholeViews, ...]

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render a panorama ``(H, W[, C])`` to images ``(n, d, d[, C])``, dtype kept."""
        return np.concatenate([part.render(image, interpolation) for part in self.parts])

    def rays(self) -> NDArray[np.float32]:
        """Those of all parts."""
        return np.concatenate([part.rays() for part in self.parts])

    def rotations(self) -> NDArray[np.float64]:
        """Those of all parts."""
        return np.concatenate([part.rotations() for part in self.parts])


@dataclass(frozen=True)
class EquirectViews:
    """The panorama itself.

    Attributes:
        rotation: ``(3, 3)`` rotation of the directions it looks in; None for none.
        columns: Where a crop starts, as a share of the columns, and its width; None for no crop.
        mirrored: Whether it is mirrored left to right.
    """

    rotation: NDArray[np.float64] | None = None
    columns: tuple[float, int] | None = None
    mirrored: bool = False

    def render(self, image: Image, interpolation: Interpolation) -> Image:
        """Render a panorama ``(H, W[, C])`` to one image ``(1, H, w[, C])``, dtype kept."""
        if self.rotation is not None:
            image = rotate_equirect(image, self.rotation.T, interpolation)
        if self.columns is not None:
            start, width = self.columns
            first = int(start * image.shape[1])
            image = image.take(np.arange(first, first + width), axis=1, mode="wrap")
        if self.mirrored:
            image = image[:, ::-1]
        return np.ascontiguousarray(image[None])

    def rays(self) -> NDArray[np.float32]:
        """None: this is no pinhole image."""
        return NO_RAYS

    def rotations(self) -> NDArray[np.float64]:
        """That of the panorama."""
        return UNTURNED if self.rotation is None else self.rotation[None]
