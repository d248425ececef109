"""The images of a grid that see the valid pixels of a panorama."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry.equirect import equirect_directions, equirect_solid_angles
from tangent_train.geometry.pinhole_grid import PinholeGrid
from tangent_train.geometry.sphere import xyz_to_lonlat

_ROWS = 180
_COARSE_ROWS = 60
_AT_ONCE = 2**23
_ROUNDING = 1e-6


def valid_cells(valid: NDArray[np.bool_], rows: int) -> NDArray[np.bool_]:
    """Return a mask of at most some rows: True for cells that contain a valid pixel.

    Args:
        valid: ``(H, W)`` valid pixels of a panorama.
        rows: Maximum number of rows.
    """
    if valid.shape[0] <= rows:
        return valid
    for axis, count in enumerate((rows, 2 * rows)):
        starts = np.arange(count) * valid.shape[axis] // count
        valid = np.logical_or.reduceat(valid, starts, axis=axis)
    return valid


def is_valid(valid: NDArray[np.bool_], directions_xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return ``(n,)`` True for directions ``(n, 3)`` in a valid pixel of a panorama ``(H, W)``."""
    height, width = valid.shape
    longitude, latitude = xyz_to_lonlat(directions_xyz).T
    row = ((0.5 - latitude / math.pi) * height).astype(int).clip(0, height - 1)
    return np.asarray(valid[row, ((longitude / math.tau + 0.5) * width).astype(int) % width])


def needed_views(
    grids: Sequence[PinholeGrid], valid: NDArray[np.bool_], *, by_owners: bool = False
) -> list[NDArray[np.int64]]:
    """Return the images that are needed to see all valid pixels.

    These are all images with a valid pixel in their center, and further images until all valid
    pixels are seen. Images that see few valid pixels are left out first.

    Args:
        grids: Images that together see all valid pixels.
        valid: ``(H, W)`` valid pixels of a panorama.
        by_owners: True if every direction must lie in the image with the nearest center; False if
            it may lie in any image.

    Returns:
        Indices of images of each grid.
    """
    cells = valid_cells(valid, _ROWS)
    shape, is_exact = (cells.shape[0], cells.shape[1]), valid.shape[0] <= _ROWS
    return _needed((*grids,), shape, cells.tobytes(), by_owners, is_exact)


def best_views(grid: PinholeGrid, valid: NDArray[np.bool_], count: int) -> NDArray[np.int64]:
    """Return the indices of the images that see most of the valid pixels.

    Args:
        grid: The images.
        valid: ``(H, W)`` valid pixels of a panorama.
        count: Number of images.
    """
    cells = valid_cells(valid, _COARSE_ROWS)
    insets = _insets(grid, _directions(cells))
    return np.sort(np.argsort(-_seen(insets >= 0, cells), kind="stable")[:count])


@lru_cache(maxsize=64)
def _needed(
    grids: tuple[PinholeGrid, ...],
    shape: tuple[int, int],
    mask: bytes,
    by_owners: bool,
    is_exact: bool,
) -> list[NDArray[np.int64]]:
    """See `needed_views`; cached, because all panoramas of a data set have the same mask."""
    cells = np.frombuffer(mask, np.bool_).reshape(shape)
    directions = _directions(cells)
    insets = np.concatenate([_insets(grid, directions) for grid in grids])
    centers = np.concatenate([grid.centers_xyz for grid in grids])
    # Pixels between the centers of coarse cells are seen too: images are convex, and the margin is
    # more than half of the diagonal of a cell.
    margin = -_ROUNDING if by_owners or is_exact else math.sin(0.75 * math.pi / shape[0])
    inner, seen = insets >= margin, insets >= -_ROUNDING
    nearness = (centers @ directions.T).astype(np.float32)
    owner = nearness.argmax(axis=0)
    kept, central = np.ones(len(centers), np.bool_), is_valid(cells, centers)
    for image in np.argsort(_seen(seen, cells), kind="stable"):
        if central[image]:
            continue
        kept[image] = False
        affected = np.flatnonzero(owner == image if by_owners else seen[image])
        covered = inner[np.ix_(kept, affected)].any(axis=0)
        if by_owners:
            others = np.where(kept[:, None], nearness[:, affected], -2.0).argmax(axis=0)
            covered = kept[others] & inner[others, affected]
        kept[image] = not covered.all()
        if by_owners and not kept[image]:
            owner[affected] = others
    ends = np.cumsum([grid.num_images for grid in grids])
    return [np.flatnonzero(part) for part in np.split(kept, ends[:-1])]


def _directions(cells: NDArray[np.bool_]) -> NDArray[np.float64]:
    return equirect_directions((cells.shape[0], cells.shape[1]))[cells]


def _seen(seen: NDArray[np.bool_], cells: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return ``(N,)`` solid angles of the valid cells that images see, by a mask ``(N, n)``."""
    angles = equirect_solid_angles((cells.shape[0], cells.shape[1]))
    weights = np.broadcast_to(angles[:, None], cells.shape)[cells]
    return np.array([weights[of_image].sum() for of_image in seen])


def _insets(grid: PinholeGrid, directions: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return ``(N, n)`` sines of the angles of directions from the nearest edges of the images.

    They are negative outside an image.
    """
    across, down = grid.half_size
    insets = np.empty((grid.num_images, len(directions)), np.float32)
    step = max(1, _AT_ONCE // max(1, len(directions)))
    for start in range(0, grid.num_images, step):
        axes = grid.world_from_camera[start : start + step]
        x, y, z = np.moveaxis(directions @ axes, -1, 0)
        beside = (across * z - np.abs(x)) / math.hypot(1, across)
        insets[start : start + step] = np.minimum(
            beside, (down * z - np.abs(y)) / math.hypot(1, down)
        )
    return insets
