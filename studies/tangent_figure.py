"""Draw a panorama and its tangent images: ``python -m studies.tangent_figure room.jpg``."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from studies.output import FOLDER
from tangent_train.geometry import (
    TangentGrid,
    equirect_directions,
    lonlat_to_equirect,
    xyz_to_lonlat,
)
from tangent_train.io.pixel_files import read_rgb, write_pixels
from tangent_train.rendering.forward import equirect_to_tangent

_Image = NDArray[np.uint8]

_WIDTH = 1600
_GAP = 4
_LEAST_WITH_CELLS = 70
"""Side in pixels below which the borders of cells are not drawn."""


def tangent_figure(image: _Image, grid: TangentGrid) -> _Image:
    """Draw a figure like the paper's teaser for one panorama.

    The panorama is above, all tangent images are below, in rows of 10·2^b by latitude, sorted by
    longitude. Both show the borders of the owned cells; at base level 0 the cells are numbered.

    Args:
        image: ``(H, W, 3)`` uint8.
        grid: Geometry of the tangent images.

    Returns:
        ``(h, w, 3)`` RGB.
    """
    columns, shape = 10 * 2**grid.base_level, (_WIDTH // 2, _WIDTH)
    step = _WIDTH // columns
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


if __name__ == "__main__":
    (name,) = sys.argv[1:]
    rgb = read_rgb(Path(name))
    write_pixels(FOLDER / "tangent_images.png", tangent_figure(rgb, TangentGrid(0, 9)))
