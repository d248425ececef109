"""Horizontal views: pinhole images with a level horizon, in rings around the vertical."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError, at_least
from tangent_train.geometry.coverage import check_coverage, overlaps
from tangent_train.geometry.pinhole_grid import PinholeGrid

_WIDEST_DEG = 170.0
_MOST_VIEWS = 360  # of a ring
_SAME = 1 - 1e-12


class Ring(NamedTuple):
    """Views that are evenly spaced around the vertical.

    Attributes:
        pitch_deg: Latitude of their centers in degrees.
        views: Number of views; the first center has longitude 0.
    """

    pitch_deg: float
    views: int


@dataclass(frozen=True, eq=False, init=False)
class RingGrid(PinholeGrid):
    """Horizontal views in rings: cameras that are yawed and pitched, but not rolled.

    The images are in the order of the rings, within a ring by growing longitude. In the middle
    column of an image, the vertical is up; a view at pitch ±90° is the view at pitch 0 tilted up
    or down.

    Args:
        rings: Rings, each with ``pitch`` in degrees (−90 to 90) and its number of ``views``.
        fov_deg: Least horizontal and vertical field of view in degrees, between the outer pixel
            edges. Pixels are square: if `size` has another ratio, one field of view is larger.
        size: Rows and columns of the images.
        rotation: ``(3, 3)`` proper rotation R of all images: directions become R·d.
        valid: ``(H, W)`` pixels of a panorama that the images must cover; None for the sphere.
        by_owners: False if images may be blended with ``feather`` only, see `check_coverage`.
        is_complete: False for images that cover them together with those of other grids.

    Raises:
        SettingError: A ring, a field of view or the size is invalid; two views have the same
            center; or the images miss a direction.

    >>> grid = RingGrid([{"pitch": 0, "views": 4}, {"pitch": 90, "views": 1},
    ...                  {"pitch": -90, "views": 1}], (100, 100), (32, 32))
    >>> grid.num_images, grid.is_overlapping
    (6, True)
    """

    rings: tuple[Ring, ...]
    size: tuple[int, int]
    rotation: NDArray[np.float64] | None

    def __init__(
        self,
        rings: Sequence[Mapping[str, float]],
        fov_deg: tuple[float, float],
        size: tuple[int, int],
        rotation: ArrayLike | None = None,
        valid: NDArray[np.bool_] | None = None,
        *,
        by_owners: bool = True,
        is_complete: bool = True,
    ) -> None:
        checked = checked_rings(rings)
        rows, columns = (at_least("dim", side, 2) for side in size)
        across, down = half_extents(fov_deg)
        pitch = max(2 * across / columns, 2 * down / rows)
        axes = np.concatenate([_axes(ring) for ring in checked])
        nearness = axes[..., 2] @ axes[..., 2].T - np.eye(len(axes))
        if nearness.max() > _SAME:
            raise SettingError(
                "rings",
                found="two views of the same direction",
                expected="views of different directions",
                remedy="Give each pitch once, with one view at 90 and -90.",
            )
        resting = PinholeGrid(axes, (rows, columns), pitch)
        if is_complete:
            check_coverage([resting], valid, by_owners=by_owners)
        overlapping = not is_complete or overlaps(resting, valid)
        super().__init__(axes, resting.size, pitch, rotation, is_overlapping=overlapping)
        vars(self).update(rings=checked)


def checked_rings(rings: Sequence[Mapping[str, float]]) -> tuple[Ring, ...]:
    """Return rings from settings.

    Raises:
        SettingError: There are no rings, or one is invalid.
    """
    checked = []
    for ring in rings:
        pitch: Any = ring.get("pitch")
        views: Any = ring.get("views")
        is_pitch = isinstance(pitch, int | float) and abs(pitch) <= 90
        is_count = isinstance(views, int) and 1 <= views <= _MOST_VIEWS
        if set(ring) != {"pitch", "views"} or not (is_pitch and is_count):
            expected = f"{{pitch: -90 to 90, views: 1 to {_MOST_VIEWS}}}"
            raise SettingError("rings", found=dict(ring), expected=expected)
        checked.append(Ring(float(ring["pitch"]), int(ring["views"])))
    if not checked:
        raise SettingError("rings", found="[]", expected="one ring or more")
    return tuple(checked)


def half_extents(fov_deg: tuple[float, float]) -> tuple[float, float]:
    """Return half the width and height of an image, in focal lengths.

    Raises:
        SettingError: A field of view is out of range.
    """
    if len(fov_deg) != 2 or not all(0 < angle <= _WIDEST_DEG for angle in fov_deg):
        expected = f"0 to {_WIDEST_DEG:g} degrees, horizontal and vertical"
        raise SettingError("fov", found=list(fov_deg), expected=expected)
    across, down = (math.tan(math.radians(angle) / 2) for angle in fov_deg)
    return across, down


def _axes(ring: Ring) -> NDArray[np.float64]:
    """Return ``(n, 3, 3)`` camera axes of the views of a ring."""
    longitudes = 2 * math.pi / ring.views * np.arange(ring.views)
    sin, cos = math.sin(math.radians(ring.pitch_deg)), math.cos(math.radians(ring.pitch_deg))
    x, y, zero = np.cos(longitudes), np.sin(longitudes), np.zeros(ring.views)
    right = np.stack([-y, x, zero], axis=-1)
    down = np.stack([sin * x, sin * y, zero - cos], axis=-1)
    forward = np.stack([cos * x, cos * y, zero + sin], axis=-1)
    return np.stack([right, down, forward], axis=-1)
