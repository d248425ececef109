"""Chart of docs/results/prior_methods.md from its tables: ``python -m studies.methods``."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MultipleLocator

DOCS = Path(__file__).parents[1] / "docs"
KINDS = {
    "UNet on views": ("#0072B2", "o", ("tangent images", "horizontal views")),
    "UNet on equirectangular images (ERP)": ("#56B4E9", "s", ("ERP",)),
    "networks on the icosphere": ("#D55E00", "^", ("ugscnn", "hex", "spherephd", "icocnn")),
    "other networks for the sphere": ("#777777", "D", ("",)),
}
"""Color, marker and beginnings of the names of each kind of method; the last kind is the rest."""


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


def kind_of(method: str) -> str:
    """Return the kind of a method, see `KINDS`."""
    method = "icocnn" if method == "spherenet_icosphere" else method
    return next(kind for kind, (_, _, names) in KINDS.items() if method.startswith(names))


def spread(places: Sequence[float], gap: float) -> list[float]:
    """Move the places of texts so that they are at least a gap apart, in the same order.

    >>> [round(place, 2) for place in spread([0.5, 0.52, 0.9], 0.1)]
    [0.46, 0.56, 0.9]
    """
    moved = np.array(places, np.float64)
    order = np.argsort(moved, kind="stable")
    for _ in range(1000):
        below, above = order[:-1], order[1:]
        short = np.maximum(gap - (moved[above] - moved[below]), 0)
        moved[below] -= short / 2
        moved[above] += short / 2
    return [float(place) for place in moved]


def picture() -> Figure:
    """Plot mIoU over the time of a panorama, and this time over the level."""
    figure = Figure((13, 5.6), layout="constrained")
    times, scores = table("prior_methods_evaluation"), table("prior_methods_time")
    quality, cost = figure.subplots(1, 2)
    for name, by_level in times.items():
        color, marker, _ = KINDS[kind_of(name)]
        look: Any = {"color": color, "marker": marker, "ms": 5}
        time, score = by_level["level 5"], scores[name]["upright"]
        quality.plot(time, score, **look)
        # To the left where another point is close on the right.
        points = [(times[other]["level 5"], scores[other]["upright"]) for other in times]
        crowded = any(1 < x / time < 1.6 and abs(y - score) < 1 for x, y in points)
        side: Any = {"xytext": (-8 if crowded else 8, 0), "ha": "right" if crowded else "left"}
        how: Any = {"textcoords": "offset points", "va": "center", "fontsize": 9, "color": color}
        quality.annotate(name, (time, score), **how, **side)
        levels = [int(column.split()[1]) for column in by_level]
        cost.plot(levels, list(by_level.values()), **look)
    ends = [list(by_level.values())[-1] for by_level in times.values()]
    for name, end, place in zip(times, ends, spread(np.log10(ends).tolist(), 0.085), strict=True):
        color = KINDS[kind_of(name)][0]
        line = {"arrowstyle": "-", "color": color, "lw": 0.6, "relpos": (0, 0.5)}
        how = {"va": "center", "fontsize": 9, "color": color, "arrowprops": line}
        cost.annotate(name, (7, end), (7.2, 10**place), **how)
    title = "Upright mIoU after the same time of training, level 5"
    quality.set(title=title, xscale="log", xlabel="ms per panorama", ylabel="mIoU %")
    quality.set_xlim(11, 120)
    cost.set(title="Cost of a method by level", yscale="log", ylabel="ms per panorama")
    cost.set(xlabel="level s", xlim=(4.9, 7.95))
    for axis in (quality.xaxis, cost.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    cost.xaxis.set_major_locator(MultipleLocator(1))
    for kind, (color, marker, _) in KINDS.items():
        quality.plot([], [], color=color, marker=marker, ls="", label=kind)
    figure.legend(loc="outside upper center", frameon=False, ncols=len(KINDS))
    return figure


if __name__ == "__main__":
    Path("figures").mkdir(exist_ok=True)
    picture().savefig("figures/methods.png", dpi=110)
