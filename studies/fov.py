"""Field of view of tangent images (the paper's table "FOV"): ``python -m studies.fov``."""

from __future__ import annotations

import math

from matplotlib.figure import Figure

from studies.output import Row, save
from tangent_train.geometry import TangentGrid
from tangent_train.results.chart import COLORS

PAPER_DEG = (73.1, 51.6, 31.5, 16.7, 8.4)
"""Fields of view in the paper's table, by base level, at level 10."""


def fov(level: int = 10) -> list[Row]:
    """Return fields of view at base levels 0 to 4.

    Args:
        level: Level s of the panorama.
    """
    rows: list[Row] = []
    for b, paper in enumerate(PAPER_DEG):
        if TangentGrid.least_dim(b, level) > 2 ** (level - b):
            continue  # images of the default size would not cover the sphere
        grid = TangentGrid(b, level)
        across = 2 * math.degrees(math.atan(grid.half_extent))
        row: Row = {"base level": b, "images": grid.num_images, "pixels": grid.dim}
        row |= {"between corners": grid.fov_deg, "paper": paper, "across the middle": across}
        rows.append({**row, "least pixels": TangentGrid.least_dim(b, level)})
    return rows


def picture() -> Figure:
    """Plot fields of view over the level of the panorama."""
    figure = Figure((8, 4.4), layout="constrained")
    axes = figure.subplots()
    tables = {level: fov(level) for level in range(4, 11)}
    for b, color in enumerate(COLORS[:5]):
        found = {level: rows[b] for level, rows in tables.items() if b < len(rows)}
        for column, style in (("between corners", "o-"), ("across the middle", ":")):
            degrees = [row[column] for row in found.values()]
            axes.plot(list(found), degrees, style, color=color, label=f"b = {b}, {column}")
    axes.plot([10] * 5, PAPER_DEG, "D", color="white", mec="black", label="the paper")
    axes.set(title="Field of view of tangent images", xlabel="level s of the panorama")
    axes.set(ylabel="degrees", ylim=(0, None))
    figure.legend(loc="outside right upper", frameon=False)
    return figure


if __name__ == "__main__":
    save("fov", fov(), picture())
