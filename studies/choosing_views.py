"""Views of one synthetic room at several levels (docs/explanation/choosing_views.md).

``python -m studies.choosing_views`` writes the picture and the table of views by image size.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from datamodules.synthrooms.datamodule import RoomSettings, generate_rooms
from studies.output import Row, save
from tangent_train.geometry import TangentGrid, lonlat_to_equirect
from tangent_train.inference.views import images_of_side, wide_levels
from tangent_train.io.palette import UNKNOWN_COLOR
from tangent_train.rendering import equirect_to_tangent
from tangent_train.results.chart import COLORS

SIDES = (224, 256, 384, 512, 640, 768, 1024)
"""Sides of the images of common photo networks."""

SHOWN = ((1, 10), (0, 9), (0, 8))
"""Base levels and levels of the views in the picture; each has 512 × 512 pixels."""

DIRECTION = (0.45, -0.2, -0.87)
"""The views are the nearest ones to this direction: ahead and down."""


def wide_views() -> list[Row]:
    """Return the views that `views=tangent` stores, by the side of the network's images."""
    rows: list[Row] = []
    for side in SIDES:
        levels = wide_levels(side)
        grids = [TangentGrid(level=level, **images_of_side(side, levels[0])) for level in levels]
        row: Row = {"network's images": f"{side} × {side}", "levels": f"[{levels[0]},{levels[1]}]"}
        row["views"] = sum(grid.num_images for grid in grids)
        row["wide, degrees"] = ", ".join(f"{grid.width_deg:.0f}" for grid in grids)
        densities = [math.radians(1 / grid.pitch) for grid in grids]
        row["pixels per degree"] = ", ".join(f"{density:.1f}" for density in densities)
        rows.append(row)
    return rows


def room(height: int = 512) -> NDArray[np.uint8]:
    """Return an RGB panorama of a synthetic room, ``(height, 2 height, 3)``, gray at the poles.

    Args:
        height: Rows.
    """
    settings = RoomSettings(seed=3, rooms={"1": 1}, height=height, supersample=1)
    with tempfile.TemporaryDirectory() as folder:
        generate_rooms(Path(folder), settings, workers=1)
        path = next(Path(folder).rglob("*_rgb.png"))
        image: Any = cv2.imread(str(path))
    image[~image.any(axis=-1)] = UNKNOWN_COLOR  # where the camera does not see
    return np.ascontiguousarray(image[..., ::-1])


def picture(panorama: NDArray[np.uint8]) -> Figure:
    """Return the panorama with the outlines of three views, and these views.

    Args:
        panorama: ``(H, W, 3)``.
    """
    figure = Figure((9, 7.6), layout="constrained")
    axes = figure.subplot_mosaic("AAA;BCD", height_ratios=(1.45, 1))
    axes["A"].imshow(panorama)
    for name, color, (base_level, level) in zip("BCD", COLORS, SHOWN, strict=False):
        grid = TangentGrid(base_level, level, 512)
        face = int(grid.owners(np.array(DIRECTION)))
        pixels = _outline(grid, face, panorama.shape[:2])
        axes["A"].plot(*pixels.T, ".", color=color, markersize=2.5)
        axes[name].imshow(equirect_to_tangent(panorama, grid)[face])
        axes[name].set_title(
            f"level {level}, base level {base_level}: {grid.width_deg:.0f}°", color=color
        )
    for one in axes.values():
        one.set_axis_off()
    return figure


def _outline(grid: TangentGrid, face: int, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the edge of a view on a panorama, ``(n, 2)`` columns and rows."""
    edge = np.ones((grid.dim, grid.dim), bool)
    edge[1:-1, 1:-1] = False
    x, y, z = np.moveaxis(grid.directions([face])[0][edge], -1, 0)
    lonlat = np.stack([np.arctan2(y, x), np.arcsin(z)], axis=-1)
    return np.asarray(lonlat_to_equirect(lonlat, (shape[0], shape[1])))


if __name__ == "__main__":
    save("choosing_views", wide_views(), picture(room()))
