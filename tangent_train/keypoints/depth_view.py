"""What a panorama knows of the room around it: distances, and where it was taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from tangent_train.errors import SettingError
from tangent_train.geometry import lonlat_to_equirect, xyz_to_lonlat
from tangent_train.rendering.taps import bilinear_equirect_taps

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.geometry import PanoramaPose

__all__ = ["DepthView"]

_SMOOTH = 1.1
"""Distances of neighbouring pixels of one surface hardly ever differ by more than this factor."""
_TOUCHED = 1e-6
"""A pixel of smaller weight is one of the four by rounding only."""


@dataclass(frozen=True, eq=False)
class DepthView:
    """What a panorama knows of the room.

    Args:
        distance_m: ``(H, W)`` distances from the centre in metres, of any resolution; 0, negative,
            infinite and NaN are missing. Pixels as in `tangent_train.geometry`.
        pose: Where it was taken.

    Raises:
        SettingError: The distances are no image of numbers.
    """

    distance_m: NDArray[np.floating]
    pose: PanoramaPose

    def __post_init__(self) -> None:
        distance_m = np.asarray(self.distance_m)
        if distance_m.ndim != 2 or not distance_m.size or distance_m.dtype.kind not in "fiu":
            raise SettingError(
                "distances",
                found=f"shape {distance_m.shape}, dtype {distance_m.dtype}",
                expected="(H, W) numbers",
            )
        if distance_m.dtype.kind != "f":
            distance_m = distance_m.astype(np.float32)
        there = np.isfinite(distance_m) & (distance_m > 0)
        object.__setattr__(self, "distance_m", np.where(there, distance_m, np.nan))

    def distances(
        self, directions_xyz: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distances in directions.

        Between four pixels of one surface 1/d is interpolated, which is linear in the direction on
        a plane. At edges of depth the distance is that of the nearest pixel that has one; its
        surface may go on towards the next pixel, farther away.

        Args:
            directions_xyz: ``(n, 3)``.

        Returns:
            ``(n,)`` distances in metres, and ``(n,)`` how far the same surface may be, NaN where
            all four pixels are missing.
        """
        height, width = self.distance_m.shape
        pixels = lonlat_to_equirect(xyz_to_lonlat(directions_xyz), (height, width))
        u, v = torch.from_numpy(pixels).unbind(1)
        index, weight = (t.numpy() for t in bilinear_equirect_taps(u, v, (height, width)))
        four = self.distance_m.reshape(-1)[index].astype(np.float64)
        touched = weight > _TOUCHED
        there = touched & ~np.isnan(four)
        farthest = np.where(there, four, -np.inf).max(axis=0)
        closest = np.where(there, four, np.inf).min(axis=0)
        nearest_pixel = np.where(there, weight, -np.inf).argmax(axis=0)
        distance = np.take_along_axis(four, nearest_pixel[None], axis=0)[0]
        smooth = (there == touched).all(axis=0) & (farthest <= _SMOOTH * closest)
        inverse = np.where(there, weight / four, 0.0).sum(axis=0)[smooth]
        distance[smooth] = 1 / inverse
        distance[~there.any(axis=0)] = np.nan
        return distance, distance * np.where(smooth, 1.0, _SMOOTH)
