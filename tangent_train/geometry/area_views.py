"""The images of a grid that see an area of the sphere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry.area import SphereArea
from tangent_train.geometry.pinhole_grid import PinholeGrid

_STEP_DEG = 1.0
_COARSE_DEG = 3.0
_LINES = 16
"""Number of lattice lines across the shorter side of an area, at least."""

_AT_ONCE = 2**23
_ROUNDING = 1e-6


def views_of_area(
    grids: Sequence[PinholeGrid], area: SphereArea, *, by_owners: bool = False
) -> list[NDArray[np.int64]]:
    """Return the images that are needed for an area.

    These are all images whose center lies in the area, and the other images without which they do
    not cover it. Where several would do, those with the largest share of pixels in the area remain.

    Args:
        grids: Images that together cover the area, under the same rotation.
        area: The area, in the same frame.
        by_owners: True if every direction of the area must lie in the image with the nearest
            center; False if it may lie in any image.

    Returns:
        Indices of images of each grid.
    """
    if area.rotation is None and all(grid.rotation is None for grid in grids):
        return [np.array(faces, np.int64) for faces in _kept((*grids,), area.angles, by_owners)]
    return _needed(grids, area, by_owners)


def best_views(grid: PinholeGrid, area: SphereArea, count: int) -> NDArray[np.int64]:
    """Return the indices of the images that see most of an area.

    Args:
        grid: The images.
        area: The area, in the same frame.
        count: Number of images.
    """
    directions, steradians = area.lattice(_step(area, _COARSE_DEG))
    shares = _shares(grid, directions, steradians, _insets(grid, directions))
    return np.sort(np.argsort(-shares, kind="stable")[:count])


@lru_cache(maxsize=64)
def _kept(
    grids: tuple[PinholeGrid, ...], angles: tuple[float, ...], by_owners: bool
) -> list[NDArray[np.int64]]:
    return _needed(grids, SphereArea.of(angles), by_owners)


def _needed(
    grids: Sequence[PinholeGrid], area: SphereArea, by_owners: bool
) -> list[NDArray[np.int64]]:
    """See `views_of_area`."""
    step = _step(area, _STEP_DEG)
    directions, steradians = area.lattice(step)
    of_grids = [_insets(grid, directions) for grid in grids]
    parts = zip(grids, of_grids, strict=True)
    shares = np.concatenate([_shares(grid, directions, steradians, part) for grid, part in parts])
    insets, centers = np.concatenate(of_grids), np.concatenate([g.centers_xyz for g in grids])
    # Directions between those of the lattice are covered too: images are convex, and the margin is
    # more than half of the diagonal of its cells.
    inner = insets >= (-_ROUNDING if by_owners else math.sin(math.radians(0.75 * step)))
    nearness = (centers @ directions.T).astype(np.float32)
    owner = nearness.argmax(axis=0)
    kept, central = np.ones(len(centers), np.bool_), area.contains(centers)
    for image in np.argsort(shares, kind="stable"):
        if central[image]:
            continue
        kept[image] = False
        affected = np.flatnonzero(owner == image if by_owners else insets[image] >= 0)
        of_others = np.where(kept[:, None], nearness[:, affected], -2.0).argmax(axis=0)
        covered = inner[np.ix_(kept, affected)].any(axis=0)
        if by_owners:
            covered = kept[of_others] & inner[of_others, affected]
        kept[image] = not covered.all()
        if not kept[image] and by_owners:
            owner[affected] = of_others
    ends = np.cumsum([grid.num_images for grid in grids])
    return [np.flatnonzero(part) for part in np.split(kept, ends[:-1])]


def _step(area: SphereArea, most_deg: float) -> float:
    return min(most_deg, area.width_deg / _LINES, (area.north - area.south) / _LINES)


def _insets(grid: PinholeGrid, directions: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return ``(N, n)`` sines of the angles of directions from the nearest edges of the images.

    They are negative outside an image.
    """
    across, down = grid.half_size
    insets = np.empty((grid.num_images, len(directions)), np.float32)
    step = max(1, _AT_ONCE // len(directions))
    for start in range(0, grid.num_images, step):
        axes = grid.world_from_camera[start : start + step]
        x, y, z = np.moveaxis(directions @ axes, -1, 0)
        beside = (across * z - np.abs(x)) / math.hypot(1, across)
        insets[start : start + step] = np.minimum(
            beside, (down * z - np.abs(y)) / math.hypot(1, down)
        )
    return insets


def _shares(
    grid: PinholeGrid,
    directions: NDArray[np.float64],
    steradians: NDArray[np.float64],
    insets: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Return ``(N,)`` shares of the pixels of the images that are inside the area."""
    shares = np.empty(len(insets))
    across, down = grid.half_size
    for image, (center, inset) in enumerate(zip(grid.centers_xyz, insets, strict=True)):
        seen = inset >= 0
        # A solid angle at an angle t from the center covers 1 / cos³ t as much of the image plane.
        plane = steradians[seen] @ (directions[seen] @ center) ** -3.0
        shares[image] = plane / (4 * across * down)
    return shares
