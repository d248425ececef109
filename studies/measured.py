"""Distortion measured on the renderers' own maps, by finite differences between pixels."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import (
    PinholeGrid,
    equirect_directions,
    equirect_solid_angles,
    equirect_to_lonlat,
    lonlat_to_xyz,
)
from tangent_train.geometry.distortion import angular_distortion, principal_scales
from tangent_train.rendering.sampling import pinhole_equirect_map

__all__ = ["Measured", "measure_equirect", "measure_grid"]

_DTYPE = np.dtype(np.float64)
_SHAPE = (512, 1024)
"""Of the panorama that the maps point into; positions are no whole numbers: any would do."""


@dataclass(frozen=True)
class Measured:
    """What is known of pixels that share the sphere among them.

    Attributes:
        angle_rad: ``(n,)`` angular distortion.
        area: ``(n,)`` scale of areas, pixels per steradian up to a factor.
        solid_angle: ``(n,)`` of the part of each pixel that its image owns.
        center_owned: ``(n,)`` whether that part has the pixel's centre in it.
    """

    angle_rad: NDArray[np.float64]
    area: NDArray[np.float64]
    solid_angle: NDArray[np.float64]
    center_owned: NDArray[np.bool_]

    @property
    def mean_angle_rad(self) -> float:
        """Mean angular distortion, by solid angle."""
        return self._mean(self.angle_rad)

    @property
    def worst_angle_rad(self) -> float:
        """Greatest angular distortion at the centre of a pixel."""
        return float(self.angle_rad[self.center_owned].max())

    @property
    def area_range(self) -> tuple[float, float]:
        """Least and greatest σ/σ̄ at the centre of a pixel."""
        owned = self.relative_area[self.center_owned]
        return float(owned.min()), float(owned.max())

    @property
    def relative_area(self) -> NDArray[np.float64]:
        """``(n,)`` σ/σ̄: scale of areas over its mean by solid angle."""
        return self.area / self._mean(self.area)

    @property
    def mean_area_deviation(self) -> float:
        """Mean of |σ/σ̄ − 1|, by solid angle."""
        return self._mean(np.abs(self.relative_area - 1))

    def _mean(self, values: NDArray[np.float64]) -> float:
        return float(np.average(values, weights=self.solid_angle))


def measure_equirect(shape: tuple[int, int]) -> Measured:
    """The panorama, from the directions of its pixels.

    Args:
        shape: ``(H, W)``, W = 2H.

    Returns:
        One column of pixels: the others are the same.
    """
    # Columns beside it on either side, as longitude has no border.
    directions = equirect_directions(shape)[:, [-1, 0, 1]]
    angle, area = _distortion(directions)
    solid_angle = equirect_solid_angles(shape)
    return Measured(angle[:, 1], area[:, 1], solid_angle, np.ones(len(solid_angle), np.bool_))


def measure_grid(grid: PinholeGrid, faces: range) -> Measured:
    """Pinhole images, from the positions in the panorama where the renderers sample it.

    Args:
        grid: The images.
        faces: Those to measure, which by symmetry stand for all others.

    Returns:
        The pixels that these images own.
    """
    parts = [_measure_image(grid, face) for face in faces]
    names = (field.name for field in fields(Measured))
    return Measured(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _measure_image(grid: PinholeGrid, face: int) -> Measured:
    world_from_pixel = grid.world_from_camera[face] @ np.linalg.inv(grid.camera_matrix)
    # What `tangent_train.rendering.tables.forward_map` holds, without keeping it.
    where = pinhole_equirect_map(world_from_pixel, (grid.dim, grid.dim), _SHAPE, _DTYPE)
    pixels_xy = np.stack([where.u, where.v], axis=-1)
    directions = lonlat_to_xyz(equirect_to_lonlat(pixels_xy, _SHAPE))
    angle, area = _distortion(directions)
    share = _owned_share(grid, face, directions)
    owned = share > 0
    part = share[owned]
    return Measured(angle[owned], area[owned], part / area[owned], part >= 0.5)


def _owned_share(
    grid: PinholeGrid, face: int, directions_xyz: NDArray[np.float64]
) -> NDArray[np.float64]:
    """``(h, w)`` the part of each pixel that its image owns, by the distance to the border."""
    near = grid.centers_xyz[np.setdiff1d(grid.neighbors[face], [face])]
    center = grid.centers_xyz[face]
    depth = directions_xyz @ center
    # Borders are straight on the plane: bisectors of the two centres.
    distance = (depth[..., None] - directions_xyz @ near.T) / depth[..., None]
    distance /= np.sqrt(1 - (near @ center) ** 2)
    return np.clip(distance.min(axis=-1) / grid.pitch + 0.5, 0, 1)


def _distortion(
    directions_xyz: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``(h, w)`` angular distortion and pixels per steradian of ``(h, w, 3)`` directions."""
    down, right = np.gradient(directions_xyz, axis=(0, 1), edge_order=2)
    greatest, least = principal_scales(np.stack([right, down], axis=-1))
    return angular_distortion(greatest, least), greatest * least
