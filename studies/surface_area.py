"""How nearly the subdivided icosahedron is a sphere (paper, figure "subdivision surface area")."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from studies.outcome import Column, Outcome, canvas, plain, png, style
from tangent_train.geometry.loop_lattice import LoopLattice
from tangent_train.results.reports.chart import COLORS

__all__ = ["surface_area"]

_COLUMNS = (
    Column("level", "level", "d"),
    Column("faces", "faces", ",d"),
    Column("ratio_mean_radius", "of its mean radius", ".6f"),
    Column("ratio_on_sphere", "vertices on it", ".6f"),
    Column("ratio_greatest_radius", "around the mesh", ".6f"),
    Column("least_radius"),
    Column("mean_radius", "mean radius", ".5f"),
    Column("greatest_radius"),
)
_NOTES = (
    "Loop subdivision draws the vertices inwards (radius 1 at level 0) to a surface that is no "
    "exact sphere. So the first ratio, of the mesh that the paper describes, ends just below 1; "
    "where the vertices are moved onto the sphere it goes to 1, the rest falling to a quarter at "
    "each level.",
    "The paper's figure is a picture without numbers, and its caption does not say which radius is "
    "meant. All three level off after level 3.",
)


def surface_area(levels: int) -> Outcome:
    """Area of the subdivided icosahedron over that of a sphere of the same radius.

    Args:
        levels: The last level; all from 0 on are computed.
    """
    lattice = LoopLattice.of_icosahedron()
    rows = [_row(lattice)]
    for _ in range(levels):
        lattice = lattice.subdivided()
        rows.append(_row(lattice))
    title = "Area of the subdivided icosahedron over that of a sphere"
    return Outcome(title, _COLUMNS, rows, _NOTES, _picture(rows))


def _row(lattice: LoopLattice) -> list[Any]:
    unit = lattice.area() / (4 * math.pi)
    on_sphere = lattice.area(on_sphere=True) / (4 * math.pi)
    least, mean, greatest = lattice.radii()
    ratios = (unit / mean**2, on_sphere, unit / greatest**2)
    return [lattice.level, lattice.num_faces, *ratios, least, mean, greatest]


def _picture(rows: Sequence[Sequence[Any]]) -> bytes:
    figure = canvas(9.0, 4.2)
    ratio, missing = figure.subplots(1, 2)
    levels = [row[0] for row in rows]
    lines = ((4, "^", "sphere around it"), (3, "s", "vertices on the sphere"))
    for k, marker, name in (*lines, (2, "o", "sphere of its mean radius (paper's mesh)")):
        color = COLORS[k - 2]
        ratio.plot(levels, [row[k] for row in rows], color=color, marker=marker, label=name)
        missing.semilogy(
            levels, [1 - row[k] for row in rows], color=color, marker=marker, label=name
        )
    ratio.axvline(3, color="#333333", linestyle="--", linewidth=1)
    style(ratio, "Area / area of the sphere", "level of subdivision", "")
    style(missing, "What is missing to 1", "level of subdivision", "")
    missing.yaxis.set_major_formatter(plain)
    for axes in (ratio, missing):
        axes.set_xticks(levels)
    handles, labels = ratio.get_legend_handles_labels()
    handles, labels = handles[::-1], labels[::-1]
    figure.legend(handles, labels, loc="outside upper left", frameon=False, ncols=len(labels))
    return png(figure)
