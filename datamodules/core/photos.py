"""Photos in memory, whatever data set they come from."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.rendering.representations.perspective import (
        PerspectiveRepresentation,
        PhotoSampler,
    )

__all__ = ["Photo", "distance_from_z_depth"]

_MOST_STEPS = np.iinfo(np.uint16).max


class Photo(NamedTuple):
    """One pinhole image.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        depth: ``(H, W)`` uint16 distance from the centre of projection in steps of 1/512 m, 0 where
            missing: the same meaning as in panoramas; or None. See `distance_from_z_depth`.
        labels: ``(H, W)`` uint8, 0 where unknown.
        camera_matrix: ``(3, 3)`` K for integer pixel centres, without skew.

    The arrays may be shared or read-only: not to be written to.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None
    labels: NDArray[np.uint8]
    camera_matrix: NDArray[np.float64]

    @property
    def up(self) -> None:
        """Unknown."""
        return

    def sampler(self, representation: PerspectiveRepresentation) -> PhotoSampler:
        """The sampler of its crops, which depend on its camera."""
        height, width = self.labels.shape
        return representation.of_camera(self.camera_matrix, (height, width))

    def target(self, representation: PerspectiveRepresentation) -> NDArray[np.uint8]:
        """``(n, d, d)`` labels of the crops, each place of the photo in one of them only."""
        crops = self.sampler(representation).whole()
        return np.where(crops.owned(), crops.render(self.labels, "nearest"), np.uint8(0))


def distance_from_z_depth(
    z_depth: NDArray[np.uint16], camera_matrix: NDArray[np.float64]
) -> NDArray[np.uint16]:
    """Distance from the centre of projection, as in panoramas, from z-depth.

    Args:
        z_depth: ``(H, W)`` depth along the optical axis in any unit, 0 where missing.
        camera_matrix: ``(3, 3)`` K for integer pixel centres.

    Returns:
        ``(H, W)`` in the same unit, rounded, at most 65535; 0 where missing.
    """
    # A ray (x, y, 1) is √(1 + x² + y²) long.
    y_squared, x_squared = (
        ((np.arange(count) - camera_matrix[axis, 2]) / camera_matrix[axis, axis]) ** 2
        for axis, count in ((1, z_depth.shape[0]), (0, z_depth.shape[1]))
    )
    length = np.sqrt(1 + np.add.outer(y_squared, x_squared))
    return np.minimum(z_depth * length + 0.5, _MOST_STEPS).astype(np.uint16)
