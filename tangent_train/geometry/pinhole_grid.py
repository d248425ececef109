"""Pinhole images around a common center: base of tangent images, cube faces and rings."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError, width_height
from tangent_train.geometry.cells import cell_neighbors
from tangent_train.geometry.sphere import checked_rotation

Faces = Sequence[int] | NDArray[np.integer]
"""Indices of images."""

_AT_ONCE = 2**24
"""Number of products of directions and images that are held at once."""


class PinholeGrid:
    """N pinhole images of the same size and pitch around a common center.

    Pixel (row i, column j) of an image sits on the plane at distance 1 in front of the camera, at
    ``(j − (w−1)/2)·p`` to the right and ``(i − (h−1)/2)·p`` down. Every direction is *owned* by the
    image with the nearest center. Where the owners show all directions that they own, a direction
    lies at most half a pixel outside the outermost pixel centers of its owner.

    Args:
        axes: ``(N, 3, 3)`` camera axes before the rotation, as `world_from_camera`; all images have
            different centers.
        size: Rows h and columns w of the images.
        pitch: Distance p of neighboring pixels on the image plane, in focal lengths.
        rotation: ``(3, 3)`` proper rotation R of all images: directions become R·d.
        is_overlapping: True if every direction is inside an image, not only on its outer edge.

    Raises:
        SettingError: The rotation is not a rotation.
    """

    def __init__(
        self,
        axes: NDArray[np.float64],
        size: tuple[int, int],
        pitch: float,
        rotation: ArrayLike | None = None,
        *,
        is_overlapping: bool = True,
    ) -> None:
        self._axes = axes
        self.size = size
        self.pitch = pitch
        self.rotation = None if rotation is None else checked_rotation(rotation)
        self.is_overlapping = is_overlapping

    @property
    def num_images(self) -> int:
        """Number N of images."""
        return len(self._axes)

    @cached_property
    def neighbors(self) -> NDArray[np.int32]:
        """``(N, k)`` neighbors of every image, padded with the image itself.

        Stepping repeatedly to the neighbor with the nearest center ends at the owner.
        """
        return cell_neighbors(self._axes[..., 2])

    def with_rotation(self, rotation: ArrayLike | None) -> Self:
        """Return the same images under another rotation.

        Raises:
            SettingError: The matrix is not a rotation.
        """
        return self._changed(rotation=None if rotation is None else checked_rotation(rotation))

    def widened(self, margin: int) -> Self:
        """Return the same images with more pixels on every side, at the same pitch."""
        rows, columns = self.size
        size = rows + 2 * margin, columns + 2 * margin
        return self._changed(size=size, is_overlapping=self.is_overlapping or margin > 0)

    def resized(self, size: tuple[int, int]) -> Self:
        """Return the same images at another resolution: their outer edges agree.

        Use it for the output of a network that downsamples or upsamples images.

        Args:
            size: Rows h' and columns w', with w'/h' = w/h; the pitch becomes p·w/w'.

        Raises:
            SettingError: A side is less than 2 pixels, or their ratio is another one.
        """
        (rows, columns), (height, width) = self.size, size
        if min(size) < 2 or height * columns != width * rows:
            expected = f"2 pixels or more, in the ratio of {width_height(self.size)}"
            raise SettingError("size", found=width_height(size), expected=expected)
        return self._changed(size=size, pitch=self.pitch * columns / width)

    def subset(self, faces: Faces) -> PinholeGrid:
        """Return some of the images; the nearest among them owns a direction.

        Args:
            faces: Indices of one or more different images.

        Raises:
            SettingError: A face is out of range.
        """
        axes, is_overlapping = self._axes[self.face_indices(faces)], self.is_overlapping
        return PinholeGrid(
            axes, self.size, self.pitch, self.rotation, is_overlapping=is_overlapping
        )

    def _changed(self, **values: Any) -> Self:
        """Return this grid with other values, without its cached properties."""
        other = copy.copy(self)
        for name in ("neighbors", "world_from_camera", "_key"):
            vars(other).pop(name, None)
        vars(other).update(values)
        return other

    @property
    def dim(self) -> int:
        """Side d of square images in pixels."""
        return self.size[0]

    @property
    def half_size(self) -> tuple[float, float]:
        """Positions x and y of the outer pixel edges on the image plane."""
        rows, columns = self.size
        return columns * self.pitch / 2, rows * self.pitch / 2

    @property
    def half_extent(self) -> float:
        """Half extent h = (d−1)/2·p: position of the outermost pixel centers on the image plane."""
        return (self.dim - 1) / 2 * self.pitch

    @property
    def fov_deg(self) -> float:
        """Angle between adjacent corners in degrees: acos(1 / (1 + 2h²)) (paper, table of FOV)."""
        return math.degrees(math.acos(1 / (1 + 2 * self.half_extent**2)))

    @property
    def width_deg(self) -> float:
        """Angle across the middle of an image, between its outer pixel edges, in degrees."""
        return math.degrees(2 * math.atan(self.half_size[0]))

    @property
    def camera_matrix(self) -> NDArray[np.float64]:
        """``(3, 3)`` pinhole matrix of every image: focal length 1/p, center (w−1)/2, (h−1)/2."""
        y, x = ((side - 1) / 2 for side in self.size)
        return np.array([[1 / self.pitch, 0, x], [0, 1 / self.pitch, y], [0, 0, 1]])

    @property
    def centers_xyz(self) -> NDArray[np.float64]:
        """``(N, 3)`` directions of the images' centers."""
        return self.world_from_camera[..., 2]

    @cached_property
    def world_from_camera(self) -> NDArray[np.float64]:
        """``(N, 3, 3)`` camera axes (x right, y down, z forward) as columns, read-only.

        The determinant is −1, because the frame of the sphere is left-handed,
        see `to_right_handed`.
        """
        axes = self._axes.copy() if self.rotation is None else self.rotation @ self._axes
        axes.setflags(write=False)
        return axes

    def directions(self, faces: Faces | None = None) -> NDArray[np.float64]:
        """Return directions of the pixel centers.

        Args:
            faces: Images to return, by default all.

        Returns:
            ``(n, h, w, 3)`` unit vectors.

        Raises:
            SettingError: A face is out of range.
        """
        rows, columns = ((np.arange(side) - (side - 1) / 2) * self.pitch for side in self.size)
        x, y = np.meshgrid(columns, rows)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        axes = self.world_from_camera[self.face_indices(faces)]
        return np.einsum("nwc,ijc->nijw", axes, rays)

    def face_indices(self, faces: Faces | None = None) -> NDArray[np.int64]:
        """Return checked indices of images, by default of all.

        Raises:
            SettingError: A face is out of range or not an integer.
        """
        if faces is None:
            return np.arange(self.num_images)
        indices = np.atleast_1d(np.asarray(faces))
        is_whole = indices.size == 0 or indices.dtype.kind in "iu"
        outside = (indices < 0) | (indices >= self.num_images)
        if not is_whole or indices.ndim != 1 or outside.any():
            raise SettingError("faces", found=faces, expected=f"indices 0 to {self.num_images - 1}")
        return indices.astype(np.int64)

    def owners(self, directions_xyz: ArrayLike) -> NDArray[np.int64]:
        """Return the face that owns each direction: the face with the nearest center.

        Args:
            directions_xyz: ``(..., 3)`` vectors of any length.

        Returns:
            ``(...)`` face indices.
        """
        directions = np.asarray(directions_xyz, np.float64)
        flat = directions.reshape(-1, 3)
        owner = np.empty(len(flat), np.int64)
        step = max(1, _AT_ONCE // self.num_images)
        for start in range(0, len(flat), step):
            part = slice(start, start + step)
            owner[part] = (flat[part] @ self.centers_xyz.T).argmax(axis=1)
        return owner.reshape(directions.shape[:-1])

    def project(self, directions_xyz: ArrayLike, faces: ArrayLike) -> NDArray[np.float64]:
        """Return pixel positions of directions in given images.

        Args:
            directions_xyz: ``(..., 3)`` vectors of any length.
            faces: Face of each direction, broadcast against ``(...)``.

        Returns:
            ``(..., 2)`` column and row; NaN where the direction is behind the image.
        """
        axes = self.world_from_camera[np.asarray(faces)]
        x, y, z = np.moveaxis(
            np.einsum("...w,...wc->...c", np.asarray(directions_xyz, np.float64), axes), -1, 0
        )
        depth = np.where(z > 0, z, np.nan)
        plane = np.stack([x / depth, y / depth], axis=-1)
        return plane / self.pitch + self.camera_matrix[:2, 2]

    def insets(self, directions_xyz: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return how far directions are inside the images.

        Args:
            directions_xyz: ``(n, 3)`` unit vectors.

        Returns:
            ``(N, n)`` sines of the angles from the nearest outer edges; negative outside an image.
        """
        across, down = self.half_size
        insets = np.empty((self.num_images, len(directions_xyz)), np.float32)
        step = max(1, _AT_ONCE // max(1, len(directions_xyz)))
        for start in range(0, self.num_images, step):
            x, y, z = np.moveaxis(
                directions_xyz @ self.world_from_camera[start : start + step], -1, 0
            )
            insets[start : start + step] = np.minimum(
                (across * z - np.abs(x)) / math.hypot(1, across),
                (down * z - np.abs(y)) / math.hypot(1, down),
            )
        return insets

    @cached_property
    def _key(self) -> tuple[object, ...]:
        rotation = None if self.rotation is None else self.rotation.tobytes()
        return self._axes.tobytes(), self.size, self.pitch, rotation, self.is_overlapping

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PinholeGrid) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)
