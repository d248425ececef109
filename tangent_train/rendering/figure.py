"""A panorama, its tangent images and the sphere they make, in one picture."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib import patheffects
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, lonlat_to_equirect, xyz_to_lonlat
from tangent_train.geometry.resized_grid import ResizedGrid
from tangent_train.rendering.figure_views import (
    FINER,
    from_inside,
    inside_positions,
    with_borders,
)
from tangent_train.rendering.forward import equirect_to_tangent
from tangent_train.rendering.tables import owner_table

__all__ = ["tangent_figure"]

_Image = NDArray[np.uint8]

_MOST_LEVELS = 3
"""Highest base level: more images would be smaller than anything on them."""

_DPI = 100
_WIDTH = 1920
_MARGIN, _GAP, _CAPTION = 16, 20, 30
_PANORAMA = (740, 370)
_LEAST_INSIDE = 380
_MONTAGE_LEFT = _MARGIN + _PANORAMA[0] + _GAP
_MOST_MONTAGE = 900
_RING = 5
_LEAST_FOR_CELLS = 80
"""Side in pixels from which images show the cells they own."""
_TEXT = "#404040"


class _Montage(NamedTuple):
    """Where the tangent images are.

    Attributes:
        side: Of every image in pixels.
        corners: ``(N, 2)`` column and row of their left upper corners.
        height: Of all of them in pixels.
    """

    side: int
    corners: NDArray[np.int64]
    height: int


def tangent_figure(panorama: NDArray[np.generic], grid: TangentGrid) -> bytes:
    """Draw the paper's teaser for one panorama.

    On the left the panorama with the cells that the images own, and the polyhedron of their planes
    from inside; on the right all tangent images with their cells: at base level 0 as the faces of
    an unfolded icosahedron, above in rows by latitude.

    Args:
        panorama: ``(H, W)`` or ``(H, W, 3)``, uint8 or uint16.
        grid: The images.

    Returns:
        A PNG file, 1920 pixels wide.

    Raises:
        SettingError: The panorama has no colours, or there are too many images.
    """
    if grid.base_level > _MOST_LEVELS:
        raise SettingError(
            "base_level", found=grid.base_level, expected=f"at most {_MOST_LEVELS} for a figure"
        )
    image = _colors(panorama)
    montage = _montage(grid)
    inside = _PANORAMA[0], max(_LEAST_INSIDE, montage.height - _PANORAMA[1] - _GAP - _CAPTION)
    top, middle = _MARGIN + _CAPTION, _MARGIN + _CAPTION + _PANORAMA[1] + _GAP
    height = max(middle + _CAPTION + inside[1], top + montage.height) + _MARGIN
    page = np.full((height, _WIDTH, 3), 255, np.uint8)
    _put(page, _panorama_view(image, grid), _MARGIN, top)
    _put(page, from_inside(image, grid, inside), _MARGIN, middle + _CAPTION)
    for thumbnail, (x, y) in zip(
        _thumbnails(image, grid, montage.side), montage.corners, strict=True
    ):
        _put(page, thumbnail, x, y + top)
    captions = [
        (_MARGIN, _MARGIN, f"Panorama, {image.shape[0]} × {image.shape[1]}"),
        (_MARGIN, middle, "The tangent images on their planes, from inside"),
        (_MONTAGE_LEFT, _MARGIN, _caption(grid)),
    ]
    numbers = _numbers(grid, montage, inside, middle + _CAPTION) if grid.base_level == 0 else []
    return _png(page, captions, numbers)


def _caption(grid: TangentGrid) -> str:
    number = f"{grid.num_images} tangent images of {grid.dim} × {grid.dim}"
    return f"{number} (base level {grid.base_level}, level {grid.level})"


def _numbers(
    grid: TangentGrid, montage: _Montage, inside: tuple[int, int], inside_top: int
) -> list[tuple[float, float, str]]:
    """The images' numbers in their middles, in all three parts of the figure."""
    top = _MARGIN + _CAPTION
    shape = _PANORAMA[1], _PANORAMA[0]
    on_panorama = lonlat_to_equirect(xyz_to_lonlat(grid.centers_xyz), shape)
    seen = inside_positions(grid.centers_xyz, inside)
    shown = np.all((seen > _GAP) & (seen < np.array(inside) - _GAP), axis=1)
    in_montage = montage.corners + montage.side / 2
    numbers = [(x + _MARGIN, y + top, str(face)) for face, (x, y) in enumerate(on_panorama)]
    numbers += [(x, y + top, str(face)) for face, (x, y) in enumerate(in_montage)]
    for face in np.flatnonzero(shown):
        numbers.append((seen[face, 0] + _MARGIN, seen[face, 1] + inside_top, str(face)))
    return numbers


def _colors(panorama: NDArray[np.generic]) -> _Image:
    if panorama.dtype not in (np.uint8, np.uint16) or panorama.shape[2:] not in ((), (3,)):
        found = f"{panorama.dtype} pixels of shape {panorama.shape}"
        raise SettingError("figure", found=found, expected="a panorama in grey or colours")
    image = panorama if panorama.dtype == np.uint8 else panorama.astype(np.uint16) >> 8
    image = image if image.ndim == 3 else image[..., None].repeat(3, axis=2)
    return np.ascontiguousarray(image, np.uint8)


def _put(page: _Image, part: _Image, x: int, y: int) -> None:
    page[y : y + part.shape[0], x : x + part.shape[1]] = part


def _panorama_view(image: _Image, grid: TangentGrid) -> _Image:
    shown = cv2.resize(image, _PANORAMA, interpolation=cv2.INTER_AREA)
    fine = FINER * _PANORAMA[1], FINER * _PANORAMA[0]
    return with_borders(shown, owner_table(grid, fine, np.dtype(np.float32)).face[0])


def _thumbnails(image: _Image, grid: TangentGrid, side: int) -> Iterator[_Image]:
    """All images, small, with the borders of the cells they own where there is room."""
    small, fine = ResizedGrid(grid, side), ResizedGrid(grid, FINER * side)
    rows = min(image.shape[0], math.ceil(math.pi / small.pitch))
    shrunk = cv2.resize(image, (2 * rows, rows), interpolation=cv2.INTER_AREA)
    for face in range(grid.num_images):
        (thumbnail,) = equirect_to_tangent(shrunk, small, [face])
        if side >= _LEAST_FOR_CELLS:
            near = fine.directions([face])[0] @ grid.centers_xyz[[face, *grid.neighbors[face]]].T
            thumbnail = with_borders(thumbnail, near.argmax(axis=-1) == 0)
        yield thumbnail


def _montage(grid: TangentGrid) -> _Montage:
    """Lay the images out in the width that is left for them."""
    rows = _rows(grid)
    places = np.zeros((grid.num_images, 2))
    for row, faces in enumerate(rows):
        # The lower faces of the icosahedron lie between the upper ones.
        first = 0.5 if grid.base_level == 0 and row < 2 else 0
        places[faces] = [(first + column, row) for column in range(len(faces))]
    across, down = places.max(axis=0) + 1
    width = _WIDTH - _MARGIN - _MONTAGE_LEFT
    step = min(width / across, _MOST_MONTAGE / down)
    gap = max(1, round(step / 40))
    left = _MONTAGE_LEFT + (width + gap - across * step) / 2
    corners = np.rint(places * step + (left, 0)).astype(np.int64)
    return _Montage(int(step) - gap, corners, round(down * step) - gap)


def _rows(grid: TangentGrid) -> list[list[int]]:
    """Faces in 4·2^b rows from north to south, each from west to east, before the rotation.

    Where a row ends within a ring of equal latitude, every second face of the ring comes first, so
    that both rows go all around.
    """
    x, y, z = grid.with_rotation(None).centers_xyz.T
    longitude = np.arctan2(y, x).round(6)
    latitude = z.round(6)
    order: list[int] = []
    for ring in sorted(set(latitude.tolist()), reverse=True):
        faces = sorted(np.flatnonzero(latitude == ring).tolist(), key=longitude.__getitem__)
        order += faces[::2] + faces[1::2] if len(faces) > _RING else faces
    columns = _RING * 2**grid.base_level
    rows = [order[start : start + columns] for start in range(0, len(order), columns)]
    return [sorted(row, key=longitude.__getitem__) for row in rows]


def _png(
    page: _Image,
    captions: Sequence[tuple[float, float, str]],
    numbers: Sequence[tuple[float, float, str]],
) -> bytes:
    height, width = page.shape[:2]
    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI)
    FigureCanvasAgg(figure)
    figure.figimage(page, origin="upper")
    for x, y, text in captions:
        figure.text(x / width, 1 - y / height, text, va="top", color=_TEXT, size=13)
    outline = [patheffects.withStroke(linewidth=2.5, foreground="black")]
    for x, y, text in numbers:
        figure.text(
            x / width, 1 - y / height, text, ha="center", va="center", color="white", size=10,
            path_effects=outline,
        )  # fmt: skip
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": "tangent-render"})
    return file.getvalue()
