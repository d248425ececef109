"""Draw a panorama and its tangent images as one figure."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import (
    TangentGrid,
    equirect_directions,
    lonlat_to_equirect,
    xyz_to_lonlat,
)
from tangent_train.rendering.forward import equirect_to_tangent

_Image = NDArray[np.uint8]

_WIDTH = 1600
_GAP = 4
_LEAST_SIDE = 12
_LEAST_WITH_CELLS = 70
"""Side in pixels below which the borders of cells are not drawn."""


def tangent_figure(panorama: NDArray[np.generic], grid: TangentGrid) -> _Image:
    """Draw a figure like the paper's teaser for one panorama.

    The panorama is above, all tangent images are below, in rows of 10·2^b by latitude, sorted by
    longitude. Both show the borders of the owned cells; at base level 0 the cells are numbered.

    Args:
        panorama: ``(H, W)`` or ``(H, W, 3)``, uint8 or uint16.
        grid: Geometry of the tangent images.

    Returns:
        ``(h, w, 3)`` RGB.

    Raises:
        SettingError: The panorama is not a gray or color image, or there are too many images.
    """
    image = _rgb(panorama)
    columns, shape = 10 * 2**grid.base_level, (_WIDTH // 2, _WIDTH)
    step = _WIDTH // columns
    if step - _GAP < _LEAST_SIDE:
        raise SettingError(
            "base_level", found=grid.base_level, expected="a smaller one, for a figure"
        )
    shown = cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA)
    above = _with_borders(shown, grid.owners(equirect_directions(shape)))
    below = np.full((grid.num_images // columns * step + _GAP, _WIDTH, 3), 255, np.uint8)
    small = grid.resized((step - _GAP, step - _GAP))
    rows = min(image.shape[0], round(np.pi / small.pitch))
    source = cv2.resize(image, (2 * rows, rows), interpolation=cv2.INTER_AREA)
    centers = lonlat_to_equirect(xyz_to_lonlat(grid.centers_xyz), shape)
    for number, face in enumerate(_reading_order(grid, columns)):
        (thumbnail,) = equirect_to_tangent(source, small, [face])
        if small.dim >= _LEAST_WITH_CELLS:
            thumbnail = _with_borders(thumbnail, small.owners(small.directions([face])[0]) == face)
        if grid.base_level == 0:
            _write_number(thumbnail, face, small.dim / 2, small.dim / 2)
            _write_number(above, face, *centers[face])
        row, column = divmod(number, columns)
        y, x = row * step + _GAP, column * step + _GAP // 2
        below[y : y + small.dim, x : x + small.dim] = thumbnail
    return np.vstack([above, below])


def _rgb(panorama: NDArray[np.generic]) -> _Image:
    if panorama.dtype not in (np.uint8, np.uint16) or panorama.shape[2:] not in ((), (3,)):
        found = f"{panorama.dtype} pixels of shape {panorama.shape}"
        raise SettingError("figure", found=found, expected="a gray or color panorama")
    image = panorama if panorama.dtype == np.uint8 else panorama.astype(np.uint16) >> 8
    image = image if image.ndim == 3 else image[..., None].repeat(3, axis=2)
    return np.ascontiguousarray(image, np.uint8)


def _reading_order(grid: TangentGrid, columns: int) -> list[int]:
    """Return faces from north to south in rows, each by longitude; the rotation is ignored."""
    longitude, latitude = xyz_to_lonlat(grid.with_rotation(None).centers_xyz).round(6).T
    order = np.lexsort((longitude, -latitude)).reshape(-1, columns)
    return [int(face) for row in order for face in row[np.argsort(longitude[row])]]


def _with_borders(image: _Image, owners: NDArray[np.generic]) -> _Image:
    """Draw white lines where the owners ``(h, w)`` of neighboring pixels differ."""
    change = np.zeros(owners.shape, np.uint8)
    change[:, 1:] |= owners[:, 1:] != owners[:, :-1]
    change[1:] |= owners[1:] != owners[:-1]
    lined = image.copy()
    lined[cv2.dilate(change, np.ones((2, 2), np.uint8)) > 0] = 255
    return lined


def _write_number(image: _Image, number: int, x: float, y: float) -> None:
    corner = (round(x) - 8, round(y) + 5)
    for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(
            image, str(number), corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, width, cv2.LINE_AA
        )
