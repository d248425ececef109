"""Chart of docs/results/prior_methods.md from its tables: ``python -m studies.methods``."""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MultipleLocator

from tangent_train.results.chart import COLORS

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


def picture() -> Figure:
    """Plot mIoU over the time of a panorama, and this time over the level."""
    figure = Figure((12, 5.4), layout="constrained")
    times, scores = table("prior_methods_evaluation"), table("prior_methods_time")
    quality, cost = figure.subplots(1, 2)
    for k, (name, by_level) in enumerate(times.items()):
        color, marker = COLORS[k % len(COLORS)], "os^"[k // len(COLORS)]
        look: Any = {"color": color, "marker": marker, "ms": 4, "label": name}
        quality.plot(by_level["level 5"], scores[name]["upright"], **look)
        look["linestyle"] = "-" if name.startswith(OURS) else "--"
        cost.plot([int(column.split()[1]) for column in by_level], list(by_level.values()), **look)
    title = "Upright mIoU after the same time of training, level 5"
    quality.set(title=title, xscale="log", xlabel="ms per panorama", ylabel="mIoU %")
    cost.set(title="Cost of a method by level", yscale="log", ylabel="ms per panorama")
    cost.set(xlabel="level s")
    for axis in (quality.xaxis, cost.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    cost.xaxis.set_major_locator(MultipleLocator(1))
    handles, names = cost.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside right center", frameon=False)
    return figure


if __name__ == "__main__":
    Path("figures").mkdir(exist_ok=True)
    picture().savefig("figures/methods.png", dpi=110)
