"""The part of the sphere that an image shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.sphere import checked_rotation, lonlat_to_xyz, xyz_to_lonlat

_ANGLES = 4


@dataclass(frozen=True, eq=False)
class SphereArea:
    """The directions between two longitudes and two latitudes, optionally rotated.

    Attributes:
        west: Longitude of the left edge of the image, −180 to 180 degrees.
        east: Longitude of its right edge; ``west > east`` for an area across ±180°, and
            ``west = -180, east = 180`` for all around.
        south: Latitude of its lower edge, −90 to 90 degrees.
        north: Latitude of its upper edge.
        rotation: ``(3, 3)`` rotation R of the area: directions become R·d; None for the identity.

    Raises:
        SettingError: The angles are not those of an area, or the matrix is not a rotation.

    >>> area = SphereArea(-180, 180, -30, 30)
    >>> round(area.share, 4)
    0.5
    >>> area.contains([[1, 0, 0], [0, 0, 1]]).tolist()
    [True, False]
    """

    west: float
    east: float
    south: float
    north: float
    rotation: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        checked_angles(self.angles)
        if self.rotation is not None:
            object.__setattr__(self, "rotation", checked_rotation(self.rotation))

    @classmethod
    def of(cls, angles: Sequence[float] | None, setting: str = "area") -> Self:
        """Return the area of a setting.

        Args:
            angles: West, east, south and north; None for the whole sphere.
            setting: Name of the setting, for messages.

        Raises:
            SettingError: The angles are not those of an area.
        """
        return cls(*((-180, 180, -90, 90) if angles is None else checked_angles(angles, setting)))

    @property
    def angles(self) -> tuple[float, float, float, float]:
        """West, east, south and north in degrees."""
        return self.west, self.east, self.south, self.north

    @property
    def numbers(self) -> NDArray[np.float64]:
        """``(13,)`` angles and rotation, for batches; inverse of `of_numbers`."""
        rotation = np.eye(3) if self.rotation is None else self.rotation
        return np.concatenate([self.angles, rotation.ravel()])

    @classmethod
    def of_numbers(cls, numbers: NDArray[np.float64]) -> Self:
        """Return the area of `numbers`."""
        rotation = numbers[_ANGLES:].reshape(3, 3)
        is_rotated = not np.array_equal(rotation, np.eye(3))
        west, east, south, north = numbers[:_ANGLES].tolist()
        return cls(west, east, south, north, rotation if is_rotated else None)

    @property
    def width_deg(self) -> float:
        """Degrees of longitude from west to east."""
        return self.east - self.west if self.east > self.west else self.east - self.west + 360

    @property
    def is_whole(self) -> bool:
        """True for the whole sphere."""
        return (self.width_deg, self.south, self.north) == (360, -90, 90)

    @property
    def share(self) -> float:
        """Share of the sphere's solid angle, above 0 to 1."""
        south, north = (math.sin(math.radians(angle)) for angle in (self.south, self.north))
        return self.width_deg / 360 * (north - south) / 2

    def rotated(self, rotation: NDArray[np.float64] | None) -> Self:
        """Return the area whose directions are R·d for the directions d of this one."""
        if rotation is None:
            return self
        inner = np.eye(3) if self.rotation is None else self.rotation
        return replace(self, rotation=rotation @ inner)

    def is_near(self, other: SphereArea) -> bool:
        """Return True if the edges of both areas agree to a degree; rotations are ignored."""
        away = np.abs(np.subtract(self.angles, other.angles))
        away[:2] = np.minimum(away[:2], 360 - away[:2])
        return bool((away <= 1).all())

    def contains(self, directions_xyz: ArrayLike) -> NDArray[np.bool_]:
        """Return ``(...)`` True for directions ``(..., 3)`` inside the area."""
        directions = np.asarray(directions_xyz, np.float64)
        resting = directions if self.rotation is None else directions @ self.rotation
        longitude, latitude = np.moveaxis(np.degrees(xyz_to_lonlat(resting)), -1, 0)
        inside = (latitude >= self.south) & (latitude <= self.north)
        return inside & ((longitude - self.west) % 360 <= self.width_deg)

    def lattice(self, step_deg: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return directions in a lattice from edge to edge, at most a step apart.

        Returns:
            ``(n, 3)`` directions and ``(n,)`` steradians, which add up to the area's solid angle.
        """
        lines, weights = [], []
        for start, angle in ((self.west, self.width_deg), (self.south, self.north - self.south)):
            count = math.ceil(angle / step_deg)
            lines.append(np.radians(start + angle / count * np.arange(count + 1)))
            weights.append(np.full(count + 1, math.radians(angle / count)))
            weights[-1][[0, -1]] /= 2
        (columns, rows), (across, down) = lines, weights
        resting = lonlat_to_xyz(np.stack(np.meshgrid(columns, rows), axis=-1)).reshape(-1, 3)
        steradians = np.outer(down * np.cos(rows), across).ravel()
        return resting if self.rotation is None else resting @ self.rotation.T, steradians


def checked_angles(angles: Sequence[float], setting: str = "area") -> Sequence[float]:
    """Return west, east, south and north of an area, see `SphereArea`.

    Raises:
        SettingError: The angles are not those of an area.
    """
    west, east, south, north = angles if len(angles) == _ANGLES else (0, 0, 0, 0)
    if not (-180 <= west <= 180 and -180 <= east <= 180 and -90 <= south < north <= 90) or (
        (east - west) % 360 == 0 and (west, east) != (-180, 180)
    ):
        raise SettingError(
            setting,
            found=list(angles),
            expected="[west,east,south,north] in degrees, −180 to 180 and −90 to 90, south below "
            "north, east other than west; [-180,180,…] is all around",
        )
    return angles
