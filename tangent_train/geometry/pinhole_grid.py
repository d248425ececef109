"""Square pinhole images around a common center: the base of tangent images and cube faces."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.sphere import checked_rotation

Faces = Sequence[int] | NDArray[np.integer]
"""Indices of images."""


class PinholeGrid(ABC):
    """N square pinhole images of the same pitch, which together cover all directions.

    Pixel (row i, column j) of an image sits on the plane at distance 1 in front of the camera, at
    ``(j − (d−1)/2)·p`` to the right and ``(i − (d−1)/2)·p`` down. Every direction is *owned* by the
    image with the nearest center. It lies at most half a pixel outside the outermost pixel centers
    of that image.

    Attributes:
        dim: Side d in pixels.
        pitch: Distance p of neighboring pixels on the image plane, in focal lengths.
        rotation: ``(3, 3)`` proper rotation R of all images: directions become R·d.
    """

    dim: int
    pitch: float
    rotation: NDArray[np.float64] | None

    @property
    @abstractmethod
    def neighbors(self) -> NDArray[np.int32]:
        """``(N, k)`` neighbors of every image, padded with the image itself.

        Stepping repeatedly to the neighbor with the nearest center ends at the owner.
        """

    @property
    @abstractmethod
    def owned_dim(self) -> int:
        """Side in pixels of the part of an image that contains every direction it owns."""

    @property
    @abstractmethod
    def is_overlapping(self) -> bool:
        """True if every direction is inside an image, not only on its outer edge."""

    @abstractmethod
    def _resting_axes(self) -> NDArray[np.float64]:
        """Return ``(N, 3, 3)`` camera axes before the rotation."""

    def _set(self, rotation: ArrayLike | None, **values: Any) -> None:
        """Set the attributes of a new grid."""
        checked = None if rotation is None else checked_rotation(rotation)
        vars(self).update(values, rotation=checked)

    @property
    def num_images(self) -> int:
        """Number N of images."""
        return len(self._resting_axes())

    def with_rotation(self, rotation: ArrayLike | None) -> Self:
        """Return the same images under another rotation.

        Raises:
            SettingError: The matrix is not a rotation.
        """
        return self._changed(rotation)

    def widened(self, margin: int) -> Self:
        """Return the same images with more pixels on every side, at the same pitch."""
        return self._changed(self.rotation, dim=self.dim + 2 * margin)

    def resized(self, dim: int) -> Self:
        """Return the same images at another resolution: their outer edges agree.

        Use it for the output of a network that downsamples or upsamples tangent images.

        Args:
            dim: Side d' in pixels; the pitch becomes p·d/d'.

        Raises:
            SettingError: The side is less than 2 pixels.
        """
        if dim < 2:
            raise SettingError("dim", found=dim, expected="2 or more")
        return self._changed(self.rotation, dim=dim, pitch=self.pitch * self.dim / dim)

    def _changed(self, rotation: ArrayLike | None, **values: Any) -> Self:
        """Return this grid with other values, without its cached properties."""
        other = object.__new__(type(self))
        kept = {
            name: value
            for name, value in vars(self).items()
            if not isinstance(getattr(type(self), name, None), cached_property)
        }
        other._set(**{**kept, "rotation": rotation, **values})
        return other

    @property
    def half_extent(self) -> float:
        """Half extent h = (d−1)/2·p: position of the outermost pixel centers on the image plane."""
        return (self.dim - 1) / 2 * self.pitch

    @property
    def width_deg(self) -> float:
        """Angle across the middle of an image, between its outer pixel edges, in degrees."""
        return math.degrees(2 * math.atan(self.dim * self.pitch / 2))

    @property
    def fov_deg(self) -> float:
        """Angle between adjacent corners in degrees: acos(1 / (1 + 2h²)) (paper, table of FOV)."""
        return math.degrees(math.acos(1 / (1 + 2 * self.half_extent**2)))

    @property
    def camera_matrix(self) -> NDArray[np.float64]:
        """``(3, 3)`` pinhole matrix of every image: focal length 1/p, center (d−1)/2."""
        center = (self.dim - 1) / 2
        return np.array([[1 / self.pitch, 0, center], [0, 1 / self.pitch, center], [0, 0, 1]])

    @cached_property
    def centers_xyz(self) -> NDArray[np.float64]:
        """``(N, 3)`` directions of the images' centers."""
        return self.world_from_camera[..., 2]

    @cached_property
    def world_from_camera(self) -> NDArray[np.float64]:
        """``(N, 3, 3)`` camera axes (x right, y down, z forward) as columns.

        The determinant is −1, because the sphere frame is mirrored (see `tangent_train.geometry`);
        ``FLIP_Y @ world_from_camera`` are proper rotations in a right-handed room.
        """
        axes = self._resting_axes()
        if self.rotation is not None:
            axes = self.rotation @ axes
        axes = axes.copy()
        axes.setflags(write=False)
        return axes

    def directions(self, faces: Faces | None = None) -> NDArray[np.float64]:
        """Return directions of the pixel centers.

        Args:
            faces: Images to return, by default all.

        Returns:
            ``(n, d, d, 3)`` unit vectors.

        Raises:
            SettingError: A face is out of range.
        """
        line = (np.arange(self.dim) - (self.dim - 1) / 2) * self.pitch
        x, y = np.meshgrid(line, line)
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
        whole = indices.size == 0 or indices.dtype.kind in "iu"
        outside = (indices < 0) | (indices >= self.num_images)
        if not whole or indices.ndim != 1 or outside.any():
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
        step = max(1, 2**24 // self.num_images)
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
        return np.stack([x / depth, y / depth], axis=-1) / self.pitch + (self.dim - 1) / 2

    @cached_property
    def _key(self) -> tuple[object, ...]:
        rotation = None if self.rotation is None else self.rotation.tobytes()
        return type(self), self.num_images, self.dim, self.pitch, rotation

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PinholeGrid) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)
