"""Fields of view of tangent images (paper, table "FOV")."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from studies.outcome import Column, Outcome, canvas, png, style
from tangent_train.geometry import TangentGrid
from tangent_train.geometry.owned_cells import owned_polygons
from tangent_train.results.reports.chart import COLORS

__all__ = ["BASE_LEVELS", "PAPER_DEG", "fov", "has_images"]

BASE_LEVELS = range(5)
PAPER_DEG = (73.1, 51.6, 31.5, 16.7, 8.4)
"""The paper's table, at level 10."""

_PAPER_LEVEL = 10
_COLUMNS = (
    Column("base_level", "base level b", "d"),
    Column("images", "images", "d"),
    Column("side_pixels", "pixels", "d"),
    Column("between_corners_deg", "between corners", ".4f"),
    Column("paper_deg", "paper", ".1f"),
    Column("across_middle_deg", "across the middle", ".4f"),
    Column("across_middle_edges_deg", "edge to edge", ".4f"),
    Column("owned_deg", "least for what it owns", ".4f"),
)
_NOTES = (
    "Between corners and across the middle are angles between the centres of the outermost pixels: "
    "acos(1/(1 + 2h²)), the paper's, and 2 atan(h), with h = (d − 1)/2 pixels. Edge to edge is "
    "half a pixel more on either side, the same at every level.",
    "The paper's angles change with the level by (d − 1)/d, as pixel centres do; R_v, and with it "
    "the plane that an image covers, does not depend on the level.",
)


def fov(level: int) -> Outcome:
    """Fields of view of tangent images at base levels 0 to 4.

    Args:
        level: Level s of the panorama.
    """
    rows = [_row(b, level) for b in BASE_LEVELS if has_images(b, level)]
    title = f"Field of view of tangent images in degrees, level s = {level}"
    return Outcome(title, _COLUMNS, rows, _NOTES, _picture(level))


def has_images(base_level: int, level: int) -> bool:
    """Whether there are tangent images: of the usual side they cover what they own."""
    return level >= base_level and TangentGrid.least_dim(base_level, level) <= 2 ** (
        level - base_level
    )


def _row(base_level: int, level: int) -> list[Any]:
    grid = TangentGrid(base_level, level)
    paper = PAPER_DEG[base_level] if level == _PAPER_LEVEL else None
    across = [2 * math.degrees(math.atan(half)) for half in (grid.half_extent, _half_side(grid))]
    owned = 2 * math.degrees(math.atan(abs(owned_polygons(grid)).max()))
    images, corners = grid.num_images, grid.fov_deg
    return [base_level, images, grid.dim, corners, paper, *across, owned]


def _half_side(grid: TangentGrid) -> float:
    return grid.dim / 2 * grid.pitch


def _picture(level: int) -> bytes:
    figure = canvas(8.0, 4.4)
    axes = figure.subplots()
    levels = range(4, max(_PAPER_LEVEL, level) + 1)
    for b in BASE_LEVELS:
        grids = [TangentGrid(b, s) for s in levels if has_images(b, s)]
        at = [grid.level for grid in grids]
        _lines(axes, at, grids, COLORS[b], b)
    paper = [_PAPER_LEVEL] * len(PAPER_DEG)
    axes.plot(paper, PAPER_DEG, "D", ms=6, color="white", mec="black", label="the paper")
    axes.set_ylim(0, None)
    axes.set_xticks(levels)
    style(axes, "Field of view of tangent images", "level s of the panorama", "degrees")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False)
    return png(figure)


def _lines(
    axes: Any, levels: Sequence[int], grids: Sequence[TangentGrid], color: str, base_level: int
) -> None:
    corners = [grid.fov_deg for grid in grids]
    middle = [2 * math.degrees(math.atan(grid.half_extent)) for grid in grids]
    axes.plot(levels, corners, "o-", color=color, label=f"b = {base_level}, between corners")
    axes.plot(levels, middle, ":", color=color, label=f"b = {base_level}, across the middle")
