"""Angular resolution of levels: ``python -m studies.angular_resolution``.

Reproduces the paper's figure "icosahedral levels" and its comparison with perspective cameras.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.figure import Figure

from studies.output import Row, save
from tangent_train.geometry import TangentGrid, equirect_shape, vertex_resolution
from tangent_train.results.chart import COLORS

PAPER_DEG = {0: 90.0, 1: 45.0, 5: 2.812, 7: 0.703, 8: 0.352, 10: 0.088}
"""Degrees per pixel in the paper, by level."""

CAMERAS = {
    "16² 45°": (16, 16, 45),
    "128² 45°": (128, 128, 45),
    "VGA 60°": (480, 640, 60),
    "1080p 60°": (1080, 1920, 60),
    "4K 60°": (2160, 3840, 60),
}
"""Rows, columns and horizontal field of view in degrees, by name of a camera."""


def angular_resolution() -> list[Row]:
    """Return rows for panoramas of levels 0 to 10, then for cameras with their equivalent level."""
    rows: list[Row] = []
    for level in range(11):
        height, width = equirect_shape(level)
        row = {"images": "panorama", "level": level, "rows": height, "cols": width}
        row |= {"° per pixel": 360 / width, "paper": PAPER_DEG.get(level, "–")}
        rows.append({**row, "vertices": 10 * 4**level + 2, "faces": 20 * 4**level})
    for name, (height, width, fov_deg) in CAMERAS.items():
        degrees = fov_deg / width
        row = {"images": name, "level": math.log2(90 / degrees), "rows": height, "cols": width}
        row |= {"° per pixel": degrees, "paper": 0.094 if name.startswith("VGA") else "–"}
        rows.append({**row, "vertices": "–", "faces": "–"})
    return rows


def picture(rows: Sequence[Row]) -> Figure:
    """Plot degrees per pixel over the level."""
    figure = Figure((8.5, 5), layout="constrained")
    axes = figure.subplots()
    levels = range(11)
    panoramas = [row["° per pixel"] for row in rows[:11]]
    between = [math.degrees(vertex_resolution(level)) for level in range(7)]
    tangent = [math.degrees(TangentGrid(1, level).pitch) for level in range(4, 11)]
    axes.semilogy(levels, panoramas, "o-", color=COLORS[0], label="panorama (ERP)")
    axes.semilogy(range(7), between, "s:", color=COLORS[6], label="between vertices (R_v)")
    label = "center of a tangent image, b = 1"
    axes.semilogy(range(4, 11), tangent, "^--", color=COLORS[2], label=label)
    printed = list(PAPER_DEG.values())
    axes.semilogy(list(PAPER_DEG), printed, "D", color="none", mec="black", label="the paper")
    for row in rows[11:]:
        axes.axhline(row["° per pixel"], color=COLORS[5], linewidth=1)
        axes.text(0, row["° per pixel"] * 1.05, row["images"], fontsize=8)
    axes.set(title="Angular resolution", xlabel="level", ylabel="degrees per pixel", xticks=levels)
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    table = angular_resolution()
    save("angular_resolution", table, picture(table))
