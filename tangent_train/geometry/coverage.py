"""Find directions that no image shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.area import SphereArea
from tangent_train.geometry.cells import cell_borders
from tangent_train.geometry.pinhole_grid import PinholeGrid
from tangent_train.geometry.sphere import xyz_to_lonlat

_STEP_DEG = 0.5
"""Distance of the directions that are tested where no closed form is known."""

_TOGETHER = 2**15
"""Number of directions that are tested at once."""


def check_coverage(
    grids: Sequence[PinholeGrid], area: SphereArea | None = None, *, by_owners: bool = False
) -> None:
    """Refuse images that together do not cover the sphere, or an area.

    Args:
        grids: The images.
        area: Area to cover; None for the sphere.
        by_owners: True if every direction must be shown by its owner, as the blend ``nearest``
            needs, of one grid; False if any image may show it.

    Raises:
        SettingError: A direction is more than half a pixel outside the outermost pixel centers.
    """
    if area is None or area.rotation is None:  # the same for every panorama
        missed = _uncovered_at_rest((*grids,), None if area is None else area.angles, by_owners)
    else:
        missed = _uncovered(grids, area, by_owners)
    if missed is None:
        return
    longitude, latitude = (f"{round(math.degrees(angle))}°" for angle in xyz_to_lonlat(missed))
    condition = ", each direction by the view with the nearest center (blend=nearest)" * by_owners
    raise SettingError(
        "views",
        found=f"{sum(grid.num_images for grid in grids)} views that miss longitude {longitude}, "
        f"latitude {latitude}",
        expected=f"views that cover {'the sphere' if area is None else 'the area'}{condition}",
        remedy="Use a larger fov or more views, or limit the views to an area.",
    )


def overlaps(grid: PinholeGrid, area: SphereArea | None = None) -> bool:
    """Return True if the interior of some image contains each direction, except single points.

    Args:
        grid: Images that cover the area.
        area: The area; None for the sphere.
    """
    borders = cell_borders(grid.centers_xyz)
    if area is None and borders is not None and _uncovered([grid], None, by_owners=True) is None:
        cells, _, middles = borders
        return bool(grid.shown(middles, on_edge=False)[np.arange(len(cells)), cells].all())
    return _tested([grid], area, by_owners=False, on_edge=False) is None


@lru_cache(maxsize=64)
def _uncovered_at_rest(
    grids: tuple[PinholeGrid, ...], angles: tuple[float, ...] | None, by_owners: bool
) -> NDArray[np.float64] | None:
    return _uncovered(grids, None if angles is None else SphereArea.of(angles), by_owners)


def _uncovered(
    grids: Sequence[PinholeGrid], area: SphereArea | None, by_owners: bool
) -> NDArray[np.float64] | None:
    """Return a direction that is not covered; None if all are."""
    grid = grids[0]
    borders = cell_borders(grid.centers_xyz) if len(grids) == 1 and area is None else None
    if borders is not None:
        # Cells and images are convex: an image covers its cell if it covers its corners.
        cells, corners, _ = borders
        missed = ~grid.shown(corners)[np.arange(len(cells)), cells]
        if not missed.any():
            return None
        if by_owners:
            return np.asarray(corners[missed.argmax()])
    return _tested(grids, area, by_owners, on_edge=True)


def _tested(
    grids: Sequence[PinholeGrid], area: SphereArea | None, by_owners: bool, on_edge: bool
) -> NDArray[np.float64] | None:
    """Return a missed direction of a dense set; None if the images show all."""
    directions = (SphereArea.of(None) if area is None else area).lattice(_STEP_DEG)[0]
    for tested in np.split(directions, range(_TOGETHER, len(directions), _TOGETHER)):
        shown = np.concatenate([grid.shown(tested, on_edge=on_edge) for grid in grids], axis=1)
        if by_owners:
            shown = np.take_along_axis(shown, grids[0].owners(tested)[:, None], axis=1)
        missed = ~shown.any(axis=1)
        if missed.any():
            # The middle of the missed ones lies well inside the gap.
            return np.asarray(tested[np.flatnonzero(missed)[missed.sum() // 2]])
    return None
