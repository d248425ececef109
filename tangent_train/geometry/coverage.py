"""Find directions that no image shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.cells import cell_borders
from tangent_train.geometry.equirect import equirect_directions
from tangent_train.geometry.pinhole_grid import PinholeGrid
from tangent_train.geometry.sphere import xyz_to_lonlat
from tangent_train.geometry.valid_views import valid_cells

_ROWS = 360
"""Rows of the panorama whose pixels are tested where no closed form is known."""

_TOGETHER = 2**15
"""Number of directions that are tested at once."""

_Mask = tuple[tuple[int, int], bytes] | None
"""Shape and content of a mask of valid pixels, as a key; None for the sphere."""


def check_coverage(
    grids: Sequence[PinholeGrid],
    valid: NDArray[np.bool_] | None = None,
    *,
    by_owners: bool = False,
) -> None:
    """Refuse images that together do not cover the sphere, or the valid pixels of a panorama.

    Args:
        grids: The images.
        valid: ``(H, W)`` pixels to cover; None for the sphere.
        by_owners: True if every direction must be shown by its owner, as the blend ``nearest``
            needs, of one grid; False if any image may show it.

    Raises:
        SettingError: A direction is more than half a pixel outside the outermost pixel centers.
    """
    missed = _uncovered((*grids,), _mask(valid), by_owners)
    if missed is None:
        return
    longitude, latitude = (f"{round(math.degrees(angle))}°" for angle in xyz_to_lonlat(missed))
    condition = ", each direction by the view with the nearest center (blend=nearest)" * by_owners
    raise SettingError(
        "views",
        found=f"{sum(grid.num_images for grid in grids)} views that miss longitude {longitude}, "
        f"latitude {latitude}",
        expected=f"views that cover {'the sphere' if valid is None else 'the area'}{condition}",
        remedy="Use a larger fov or more views, or limit the views to an area.",
    )


def overlaps(grid: PinholeGrid, valid: NDArray[np.bool_] | None = None) -> bool:
    """Return True if the interior of some image contains each direction, except single points.

    Args:
        grid: Images that cover the valid pixels.
        valid: ``(H, W)`` pixels to test; None for the sphere.
    """
    borders = cell_borders(grid.centers_xyz)
    if valid is None and borders is not None and _uncovered((grid,), None, by_owners=True) is None:
        cells, _, middles = borders
        return bool(grid.shown(middles, on_edge=False)[np.arange(len(cells)), cells].all())
    return _tested([grid], _mask(valid), by_owners=False, on_edge=False) is None


def _mask(valid: NDArray[np.bool_] | None) -> _Mask:
    if valid is None:
        return None
    cells = valid_cells(valid, _ROWS)
    return (cells.shape[0], cells.shape[1]), cells.tobytes()


@lru_cache(maxsize=64)
def _uncovered(
    grids: tuple[PinholeGrid, ...], mask: _Mask, by_owners: bool
) -> NDArray[np.float64] | None:
    """Return a direction that is not covered; None if all are."""
    grid = grids[0]
    borders = cell_borders(grid.centers_xyz) if len(grids) == 1 and mask is None else None
    if borders is not None:
        cells, corners, _ = borders
        missed = ~grid.shown(corners)[np.arange(len(cells)), cells]
        if not missed.any():
            return None
        if by_owners:
            return np.asarray(corners[missed.argmax()])
    return _tested(grids, mask, by_owners, on_edge=True)


def _tested(
    grids: Sequence[PinholeGrid], mask: _Mask, by_owners: bool, on_edge: bool
) -> NDArray[np.float64] | None:
    """Return a missed direction of a dense set; None if the images show all."""
    shape, content = mask or ((_ROWS, 2 * _ROWS), b"\1" * (2 * _ROWS**2))
    directions = equirect_directions(shape)[np.frombuffer(content, np.bool_).reshape(shape)]
    for tested in np.split(directions, range(_TOGETHER, len(directions), _TOGETHER)):
        shown = np.concatenate([grid.shown(tested, on_edge=on_edge) for grid in grids], axis=1)
        if by_owners:
            shown = np.take_along_axis(shown, grids[0].owners(tested)[:, None], axis=1)
        missed = ~shown.any(axis=1)
        if missed.any():
            # The middle of the missed ones lies well inside the gap.
            return np.asarray(tested[np.flatnonzero(missed)[missed.sum() // 2]])
    return None
