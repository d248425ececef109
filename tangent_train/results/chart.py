"""Draw the chart of a report: bars of scores, and lines over the latitude."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray

from tangent_train.results.evaluation import EvaluationResult
from tangent_train.results.rows import Part, RunRow, Statistic

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999")
"""Colors of Okabe and Ito, which people with color blindness can distinguish."""

_LONGEST_LABEL = 60
_ERROR_BARS = "bars: standard deviation over folds, else over seeds, else 95 % interval over images"

_Ticks = Mapping[str, tuple[str, Part]]
"""Score and part of the images of each group of bars, by name."""


def report_png(title: str, rows: Sequence[RunRow], like: EvaluationResult) -> bytes:
    """Draw bars of the means and of each class, and lines over the latitude.

    Error bars are the standard deviation over folds, else over seeds, else the 95 % interval over
    the images of a single run. Bars of published scores are hatched.

    Args:
        title: Title of the chart.
        rows: Rows with the same scores and classes.
        like: Evaluation with these scores and classes.

    Returns:
        Content of a PNG file.
    """
    panels: list[tuple[str, str, _Ticks]] = []  # title, unit and bars
    for unit in dict.fromkeys(column.unit for column in like.main_columns.values()):
        main = {c.text: (n, None) for n, c in like.main_columns.items() if c.unit == unit}
        panels.append(("" if panels else f"{title}\n{_ERROR_BARS}", unit, main))
    if score := like.main_of_class:
        column = like.columns[like.class_means[score]]
        classes = {name: (score, name) for name in like.class_names}
        panels.append((f"{column.class_text} of each class", column.unit, classes))
    has_bands = any(row.bands for row in rows)
    count = len(panels) + has_bands
    width = max(10.0, 0.12 * len(panels[-1][2]) * len(rows))
    figure = Figure((width, 3.6 * count + 0.2 * len(rows)), dpi=120, layout="constrained")
    plots = figure.subplots(count, 1, squeeze=False)[:, 0]
    for axes, (heading, unit, ticks) in zip(plots, panels, strict=False):
        axes.set_title(heading, loc="left")
        _draw_bars(axes, rows, ticks, unit)
    if has_bands:
        column = like.columns[like.main]
        plots[-1].set_title(f"{column.text} by latitude", loc="left")
        _draw_bands(plots[-1], rows, like.main, column.unit)
    handles, labels = plots[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", frameon=False, ncols=2)
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # "$" in a name does not begin a formula
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def _draw_bars(axes: Axes, rows: Sequence[RunRow], ticks: _Ticks, unit: str) -> None:
    width, places = 0.8 / len(rows), np.arange(len(ticks))
    for k, (row, (color, is_repeated)) in enumerate(zip(rows, _colors(rows), strict=True)):
        scores, hatch = [row.score(*key) for key in ticks.values()], "xx" if is_repeated else ""
        label, half = row.label, _LONGEST_LABEL // 2
        if len(label) > _LONGEST_LABEL:  # settings that differ are at its end
            label = f"{label[:half]} … {label[-half:]}"
        axes.bar(
            places + (k - (len(rows) - 1) / 2) * width,
            _in_unit([score.mean for score in scores], unit),
            0.92 * width,
            yerr=_in_unit([_error_bar(score) for score in scores], unit).T,
            color=color,
            hatch="//" if row.label.endswith("(paper)") else hatch,
            label=label,
            error_kw={"elinewidth": 1.2, "capsize": min(4.0, 14 * width), "ecolor": "#333333"},
        )
    axes.set_xticks(places, list(ticks))
    _format_axes(axes, unit)


def _draw_bands(axes: Axes, rows: Sequence[RunRow], score: str, unit: str) -> None:
    for row, (color, is_repeated) in zip(rows, _colors(rows), strict=True):
        bands, line = sorted(row.bands), "--" if is_repeated else "-"
        means = _in_unit([row.score(score, band).mean for band in bands], unit)
        axes.plot([sum(band) / 2 for band in bands], means, line, color=color, marker=".")
    axes.set_xticks(range(-90, 91, 30), [f"{k}°" for k in range(-90, 91, 30)])
    _format_axes(axes, unit)
    axes.set_xlim(-90, 90)


def _colors(rows: Sequence[RunRow]) -> list[tuple[str, bool]]:
    """Return the color of each row, which its row of the paper shares, and True if it repeats."""
    names = [row.label.removesuffix(" (paper)") for row in rows]
    numbers = [list(dict.fromkeys(names)).index(name) for name in names]
    return [(COLORS[k % len(COLORS)], k >= len(COLORS)) for k in numbers]


def _error_bar(score: Statistic) -> tuple[float | None, float | None]:
    """Return the lengths of an error bar below and above the mean."""
    spread = score.over_seeds if score.over_folds is None else score.over_folds
    if spread is not None or score.mean is None or score.interval is None:
        return spread, spread
    low, high = score.interval
    # The mean over few images may be outside the interval.
    return max(score.mean - low, 0), max(high - score.mean, 0)


def _in_unit(values: Sequence[Any], unit: str) -> NDArray[np.float64]:
    """Return the numbers to draw; NaN, which draws nothing, for None."""
    return np.array(values, np.float64) * (100 if unit == "%" else 1)


def _format_axes(axes: Axes, unit: str) -> None:
    if unit == "%":
        axes.set_ylim(0, 105)
    axes.set_ylabel(unit)
    axes.margins(x=0.01)
    axes.grid(axis="y", color="#dddddd")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
