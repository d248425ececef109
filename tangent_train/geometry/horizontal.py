"""Horizontal views: pinhole images with a level horizon, in rings around the vertical."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.coverage import check_coverage, overlaps
from tangent_train.geometry.pinhole_grid import PinholeGrid

_WIDEST_DEG = 170.0
_MOST_VIEWS = 360  # of a ring


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
        if min(size) < 2:
            raise SettingError("dim", found=size, expected="2 or more rows and columns")
        across, down = half_extents(fov_deg)
        pitch = max(2 * across / size[1], 2 * down / size[0])
        axes = np.concatenate([_axes(ring) for ring in rings])
        nearness = axes[..., 2] @ axes[..., 2].T - np.eye(len(axes))
        if nearness.max() > 1 - 1e-12:
            raise SettingError(
                "rings",
                found="two views of the same direction",
                expected="views of different directions",
                remedy="Give each pitch once, with one view at 90 and -90.",
            )
        super().__init__(axes, (size[0], size[1]), pitch, rotation)
        resting = self.with_rotation(None)
        if is_complete:
            check_coverage([resting], valid, by_owners=by_owners)
            self.is_overlapping = overlaps(resting, valid)


def half_extents(fov_deg: Sequence[float]) -> tuple[float, float]:
    """Return half the width and height of an image, in focal lengths.

    Raises:
        SettingError: A field of view is out of range.
    """
    if len(fov_deg) != 2 or not all(0 < angle <= _WIDEST_DEG for angle in fov_deg):
        expected = f"0 to {_WIDEST_DEG:g} degrees, horizontal and vertical"
        raise SettingError("fov", found=list(fov_deg), expected=expected)
    across, down = (math.tan(math.radians(angle) / 2) for angle in fov_deg)
    return across, down


def _axes(ring: Mapping[str, float]) -> NDArray[np.float64]:
    """Return ``(n, 3, 3)`` camera axes of the views of a ring; the first has longitude 0."""
    pitch, views = ring.get("pitch", math.nan), ring.get("views", 0)
    if set(ring) != {"pitch", "views"} or not (abs(pitch) <= 90 and 1 <= views <= _MOST_VIEWS):
        expected = f"{{pitch: -90 to 90, views: 1 to {_MOST_VIEWS}}}"
        raise SettingError("rings", found=dict(ring), expected=expected)
    longitudes = 2 * math.pi / views * np.arange(views)
    sin, cos = math.sin(math.radians(pitch)), math.cos(math.radians(pitch))
    x, y, zero = np.cos(longitudes), np.sin(longitudes), np.zeros_like(longitudes)
    right = np.stack([-y, x, zero], axis=-1)
    down = np.stack([sin * x, sin * y, zero - cos], axis=-1)
    forward = np.stack([cos * x, cos * y, zero + sin], axis=-1)
    return np.stack([right, down, forward], axis=-1)
