"""A cube map once more: slow, float64, from the textbook's table and nothing else.

No line here is shared with the library, which is tested against it: a face is the coordinate of the
largest magnitude, a place on it the ratios of the other two (as in the OpenGL specification's table
of major axes), where the library works with camera matrices.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tests.rendering.reference import (
    Array,
    certain_labels,
    panorama_lonlat,
    sample_images,
    sample_panorama,
    to_lonlat,
    to_xyz,
)


def _ray(face: int, right: Array, down: Array) -> Array:
    """The point of a face of the cube from −1 to 1: x ahead, y to the right, z up."""
    one = np.ones_like(right)
    x, y, z = [
        (one, right, -down),  # front
        (-right, one, -down),  # right
        (-one, -right, -down),  # back
        (right, -one, -down),  # left
        (down, right, one),  # up: its lowest row is beside the front
        (-down, right, -one),  # down: its top row is beside the front
    ][face]
    return np.stack([x, y, z], axis=-1)


@dataclass(frozen=True)
class ReferenceCube:
    """All six faces; `rotation` turns the cube."""

    dim: int
    rotation: Array = field(default_factory=lambda: np.eye(3))

    def lonlat(self, face: int) -> Array:
        """``(d, d, 2)`` where the pixels of a face are on the sphere."""
        edges = np.linspace(-1, 1, self.dim + 1)
        middles = (edges[:-1] + edges[1:]) / 2
        right, down = np.meshgrid(middles, middles)
        return to_lonlat(_ray(face, right, down) @ self.rotation.T)

    def forward(self, image: Array, interpolation: str = "bilinear") -> Array:
        """``(H, W, C)`` -> ``(6, d, d, C)``."""
        return np.stack([sample_panorama(image, self.lonlat(f), interpolation) for f in range(6)])

    def nearness(self, shape: tuple[int, int]) -> Array:
        """``(H, W, 6)`` coordinates of the panorama's pixels along the six axes."""
        x, y, z = np.moveaxis(to_xyz(panorama_lonlat(shape)) @ self.rotation, -1, 0)
        return np.stack([x, y, -x, -y, z, -z], axis=-1)

    def owner(self, shape: tuple[int, int]) -> NDArray[np.int64]:
        """``(H, W)`` the face of the largest coordinate."""
        return self.nearness(shape).argmax(axis=-1)

    def backward(self, images: Array, shape: tuple[int, int]) -> Array:
        """``(6, d, d, C)`` -> ``(H, W, C)``."""
        x, y, _, _, z, _ = np.moveaxis(self.nearness(shape), -1, 0)
        owner, depth = self.owner(shape), self.nearness(shape).max(axis=-1)
        right = np.choose(owner, [y, -x, -y, x, y, y]) / depth
        down = np.choose(owner, [-z, -z, -z, -z, x, -x]) / depth
        row, column = ((side + 1) / 2 * self.dim - 0.5 for side in (down, right))
        return sample_images(images, owner, row, column)

    def clear(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Panorama pixels that are not on an edge of the cube: their owner is certain."""
        return certain_labels(self.nearness(shape), margin=1e-9)
