"""The images that show the sphere, or the valid pixels of a panorama."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry.camera import pixel_solid_angles
from tangent_train.geometry.sphere import equirect_directions, lonlat_to_xyz, xyz_to_lonlat

if TYPE_CHECKING:
    from tangent_train.geometry.grids import PinholeGrid

_ROWS = 180
_COARSE_ROWS = 60
_STEP_DEG = 0.5
"""Distance of the directions in which images are tested to cover the whole sphere."""

_ROUNDING = 1e-6

_Mask = tuple[tuple[int, int], bytes] | None
"""Shape and content of a mask of valid cells, as a key of caches; None for the sphere."""


def check_coverage(
    grids: Sequence[PinholeGrid],
    valid: NDArray[np.bool_] | None = None,
    *,
    by_owners: bool = False,
    remedy: str = "Use a larger fov or more views, or limit the views to an area.",
) -> None:
    """Refuse images that together do not cover the sphere, or the valid pixels of a panorama.

    Args:
        grids: The images.
        valid: ``(H, W)`` pixels to cover; None for the sphere.
        by_owners: True if every direction must be shown by its owner, as the blend ``nearest``
            needs, of one grid; False if any image may show it.
        remedy: Remedy in the message.

    Raises:
        SettingError: A direction is more than half a pixel outside the outermost pixel centers.
    """
    missed = _missed((*grids,), _mask(valid), by_owners, -_ROUNDING)
    if missed is not None:
        longitude, latitude = np.degrees(xyz_to_lonlat(missed))
        count = sum(grid.num_images for grid in grids)
        owners = ", each direction by the view with the nearest center (blend=nearest)" * by_owners
        raise SettingError(
            "views",
            found=f"{count} views that miss longitude {longitude:.0f}°, latitude {latitude:.0f}°",
            expected=f"views that cover {'the sphere' if valid is None else 'the area'}{owners}",
            remedy=remedy,
        )


def overlaps(grid: PinholeGrid, valid: NDArray[np.bool_] | None = None) -> bool:
    """Return True if the interior of some image contains each direction, except single points.

    Args:
        grid: Images that cover the valid pixels.
        valid: ``(H, W)`` pixels to test; None for the sphere.
    """
    return _missed((grid,), _mask(valid), False, _ROUNDING) is None


@lru_cache(maxsize=64)
def _missed(
    grids: tuple[PinholeGrid, ...], mask: _Mask, by_owners: bool, least: float
) -> NDArray[np.float64] | None:
    """Return a direction that is not inside any image by at least a sine; None if all are."""
    directions = _cells(mask)[1]
    if mask is None:
        angles = np.meshgrid(np.arange(-180, 180, _STEP_DEG), np.arange(-90, 91, _STEP_DEG))
        directions = lonlat_to_xyz(np.radians(np.stack(angles, axis=-1))).reshape(-1, 3)
        if least > 0:  # views that meet at a pole overlap around it
            directions = directions[np.abs(directions[:, 2]) < 1]
    insets = np.concatenate([grid.insets(directions) for grid in grids])
    owner = grids[0].owners(directions) if by_owners else insets.argmax(axis=0)
    missed = np.flatnonzero(np.take_along_axis(insets, owner[None], axis=0)[0] < least)
    # The middle of the missed ones lies well inside the gap.
    return directions[missed[len(missed) // 2]] if len(missed) else None


def _mask(valid: NDArray[np.bool_] | None, rows: int = 2 * _ROWS) -> _Mask:
    """Return a mask of at most some rows, whose cells contain a valid pixel."""
    if valid is None:
        return None
    if valid.shape[0] > rows:
        for axis, count in enumerate((rows, 2 * rows)):
            starts = np.arange(count) * valid.shape[axis] // count
            valid = np.logical_or.reduceat(valid, starts, axis=axis)
    return (valid.shape[0], valid.shape[1]), valid.tobytes()


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
    return _needed((*grids,), _mask(valid, _ROWS), by_owners, valid.shape[0] <= _ROWS)


def best_views(grid: PinholeGrid, valid: NDArray[np.bool_], count: int) -> NDArray[np.int64]:
    """Return the indices of the images that see most of the valid pixels.

    Args:
        grid: The images.
        valid: ``(H, W)`` valid pixels of a panorama.
        count: Number of images.
    """
    _, directions, angles = _cells(_mask(valid, _COARSE_ROWS))
    seen = (grid.insets(directions) >= 0) @ angles
    return np.sort(np.argsort(-seen, kind="stable")[:count])


def is_valid(valid: NDArray[np.bool_], directions_xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return ``(n,)`` True for directions ``(n, 3)`` in a valid pixel of a panorama ``(H, W)``."""
    (height, width), (longitude, latitude) = valid.shape, xyz_to_lonlat(directions_xyz).T
    row = ((0.5 - latitude / math.pi) * height).astype(int).clip(0, height - 1)
    return np.asarray(valid[row, ((longitude / math.tau + 0.5) * width).astype(int) % width])


def _cells(
    mask: _Mask,
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Return a mask, and the directions ``(n, 3)`` and solid angles ``(n,)`` of its cells."""
    shape, content = mask or ((1, 1), b"\1")
    cells = np.frombuffer(content, np.bool_).reshape(shape)
    return cells, equirect_directions(shape)[cells], pixel_solid_angles(shape)[cells]


@lru_cache(maxsize=64)
def _needed(
    grids: tuple[PinholeGrid, ...], mask: _Mask, by_owners: bool, is_exact: bool
) -> list[NDArray[np.int64]]:
    """See `needed_views`; cached, because all panoramas of a data set have the same mask."""
    cells, directions, _ = _cells(mask)
    insets = np.concatenate([grid.insets(directions) for grid in grids])
    centers = np.concatenate([grid.centers_xyz for grid in grids])
    # Pixels between the centers of coarse cells are seen too: images are convex, and the margin is
    # more than half of the diagonal of a cell.
    margin = -_ROUNDING if is_exact else math.sin(0.75 * math.pi / len(cells))
    inner, seen = insets >= margin, insets >= -_ROUNDING
    nearness = (centers @ directions.T).astype(np.float32)
    owner = nearness.argmax(axis=0)
    kept, central = np.ones(len(centers), np.bool_), is_valid(cells, centers)
    for image in np.argsort(seen.sum(axis=1), kind="stable"):
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
