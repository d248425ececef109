"""Chart of docs/results/prior_methods.md from its tables: ``python -m studies.methods``."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MultipleLocator

from studies.output import COLORS

DOCS = Path(__file__).parents[1] / "docs"
OURS = ("tangent images", "horizontal views", "ERP")
"""Beginnings of the names of methods that use ordinary networks; the others are dashed."""


def table(name: str) -> dict[str, dict[str, float]]:
    """Return the numbers of a table, by method and column.

    Args:
        name: Name of a CSV file in docs/results/data with a column "method".
    """
    with (DOCS / "results" / "data" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["method"]: {
            column: float(found[0].replace(",", ""))
            for column, cell in row.items()
            if (found := re.match(r"[\d.,]+", cell))
        }
        for row in rows
    }


def label(axes: Any, ends: dict[str, tuple[float, float]], colors: dict[str, str]) -> None:
    """Write names to the right of the axes, apart from each other, with lines to their points.

    Args:
        axes: Axes with final scales and limits.
        ends: Points in data coordinates, by name.
        colors: Colors by name.
    """
    to_axes = axes.transData + axes.transAxes.inverted()
    places = {name: to_axes.transform(point) for name, point in ends.items()}
    names, gap = sorted(places, key=lambda name: places[name][1]), 0.052
    heights: list[float] = []
    for name in names:
        heights.append(max([places[name][1], *(height + gap for height in heights[-1:])]))
    while heights[-1] > 1 or heights[0] > places[names[0]][1] + gap:
        heights = [height - gap / 4 for height in heights]
    for name, height in zip(names, heights, strict=True):
        axes.annotate(
            name,
            places[name],
            (1.03, height),
            "axes fraction",
            "axes fraction",
            fontsize=9,
            va="center",
            color=colors[name],
            arrowprops={"arrowstyle": "-", "color": colors[name], "lw": 0.5, "relpos": (0, 0.5)},
        )


def picture() -> Figure:
    """Plot mIoU over the time of a panorama, and this time over the level."""
    figure = Figure((12, 5.4), layout="constrained")
    times, scores = table("prior_methods_evaluation"), table("prior_methods_time")
    colors = {name: COLORS[k % len(COLORS)] for k, name in enumerate(times)}
    titles = "Upright mIoU after the same time of training, level 5", "Cost of a method by level"
    for axes, title in zip(figure.subplots(1, 2), titles, strict=True):
        is_scores, ends = title == titles[0], {}
        for name, by_level in times.items():
            points = [(float(column.split()[1]), ms) for column, ms in by_level.items()]
            if is_scores:
                points = [(by_level["level 5"], scores[name]["upright"])]
            style = "o-" if name.startswith(OURS) else "s--"
            axes.plot(*zip(*points, strict=True), style, color=colors[name], ms=4)
            ends[name] = points[-1]
        axes.set(title=title, xscale="log" if is_scores else "linear")
        axes.set(yscale="linear" if is_scores else "log")
        axes.set(xlabel="ms per panorama" if is_scores else "level s")
        axes.set(ylabel="mIoU %" if is_scores else "ms per panorama")
        logarithmic, linear = axes.xaxis, axes.yaxis
        if not is_scores:
            logarithmic, linear = linear, logarithmic
        logarithmic.set_major_locator(LogLocator(subs=(1, 2, 5)))
        logarithmic.set_major_formatter("{x:g}")
        logarithmic.set_minor_formatter("")
        linear.set_major_locator(MultipleLocator(10 if is_scores else 1))
        axes.spines[["top", "right"]].set_visible(False)
        label(axes, ends, colors)
    return figure


if __name__ == "__main__":
    Path("figures").mkdir(exist_ok=True)
    picture().savefig("figures/methods.png", dpi=110)
