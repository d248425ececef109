"""Draw the chart of a report: bars of scores, and lines over the latitude."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from tangent_train.results.evaluation_result import EvaluationResult
from tangent_train.results.rows import RunRow, Statistic

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999")
"""Colors of Okabe and Ito, which people with color blindness can distinguish."""

_LONGEST_LABEL = 60
_ERROR_BARS = "bars: standard deviation over folds, else over seeds, else 95 % interval over images"


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
    panels: list[_Panel] = []
    columns = like.main_columns
    for unit in dict.fromkeys(column.unit for column in columns.values()):
        shown = {n: c.text for n, c in columns.items() if c.unit == unit}
        means = [[row.score(name) for name in shown] for row in rows]
        panels.append(_Panel("" if panels else title, list(shown.values()), means, unit))
    if score := like.main_of_class:
        column, names = like.columns[like.class_means[score]], like.class_names
        classes = [[row.score(score, name) for name in names] for row in rows]
        panels.append(_Panel(f"{column.class_text} of each class", names, classes, column.unit))
    return _png(rows, panels, like)


class _Panel(NamedTuple):
    """A group of bars for each tick; `scores` by row and tick."""

    title: str
    ticks: Sequence[str]
    scores: Sequence[Sequence[Statistic]]
    unit: str


def _png(
    rows: Sequence[RunRow], panels: Sequence[_Panel], like: EvaluationResult | None = None
) -> bytes:
    """Draw panels of bars, and lines over the latitude for rows with latitude bands."""
    has_bands = any(row.bands for row in rows)
    count = len(panels) + has_bands
    width = max(10.0, 0.12 * len(panels[-1].ticks) * len(rows))
    figure = Figure((width, 3.6 * count + 0.2 * len(rows)), dpi=120, layout="constrained")
    plots = figure.subplots(count, 1, squeeze=False)[:, 0]
    for axes, panel in zip(plots, panels, strict=False):
        axes.set_title(panel.title, loc="left")
        _bars(axes, rows, panel)
    plots[0].set_title(f"{panels[0].title}\n{_ERROR_BARS}", loc="left")
    if has_bands and like is not None:
        column = like.columns[like.main]
        plots[-1].set_title(f"{column.text} by latitude", loc="left")
        _band_lines(plots[-1], rows, like.main, column.unit)
    handles, labels = plots[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", frameon=False, ncols=2)
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # "$" in a name does not begin a formula
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def _bars(axes: Axes, rows: Sequence[RunRow], panel: _Panel) -> None:
    width, ticks = 0.8 / len(rows), panel.ticks
    for k, (row, number, scores) in enumerate(zip(rows, _numbers(rows), panel.scores, strict=True)):
        is_repeated = number >= len(COLORS)  # its color
        axes.bar(
            np.arange(len(ticks)) + (k - (len(rows) - 1) / 2) * width,
            _in_unit([score.mean for score in scores], panel.unit),
            0.92 * width,
            yerr=np.transpose([_in_unit(_error_bar(score), panel.unit) for score in scores]),
            color=COLORS[number % len(COLORS)],
            hatch="//" if row.is_published else "xx" if is_repeated else "",
            label=_short(row.label),
            error_kw={"elinewidth": 1.2, "capsize": min(4.0, 14 * width), "ecolor": "#333333"},
        )
    axes.set_xticks(np.arange(len(ticks)), ticks)
    _score_axis(axes, panel.unit)


def _band_lines(axes: Axes, rows: Sequence[RunRow], score: str, unit: str) -> None:
    for row, number in zip(rows, _numbers(rows), strict=True):
        bands = sorted(row.bands)
        centers = [(south + north) / 2 for south, north in bands]
        shown = _in_unit([row.score(score, band).mean for band in bands], unit)
        line = "--" if number >= len(COLORS) else "-"
        axes.plot(centers, shown, line, color=COLORS[number % len(COLORS)], marker=".")
    axes.set_xticks(range(-90, 91, 30), [f"{k}°" for k in range(-90, 91, 30)])
    _score_axis(axes, unit)
    axes.set_xlim(-90, 90)


def _numbers(rows: Sequence[RunRow]) -> list[int]:
    """Return a number of each row for its color; a row and its row of the paper share a number."""
    names = list(dict.fromkeys(row.label.removesuffix(" (paper)") for row in rows))
    return [names.index(row.label.removesuffix(" (paper)")) for row in rows]


def _error_bar(score: Statistic) -> list[float | None]:
    """Return the lengths of an error bar below and above the mean."""
    spread = score.over_seeds if score.over_folds is None else score.over_folds
    if spread is not None or score.mean is None or score.interval is None:
        return [spread, spread]
    low, high = score.interval
    # The mean over few images may be outside the interval.
    return [max(score.mean - low, 0), max(high - score.mean, 0)]


def _in_unit(values: Sequence[float | None], unit: str) -> list[float]:
    """Return the numbers to draw; NaN, which draws nothing, for None."""
    scale = 100 if unit == "%" else 1
    return [np.nan if value is None else scale * value for value in values]


def _score_axis(axes: Axes, unit: str) -> None:
    if unit == "%":
        axes.set_ylim(0, 105)
    axes.set_ylabel(unit)
    axes.margins(x=0.01)
    axes.grid(axis="y", color="#dddddd")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _short(label: str) -> str:
    """Shorten a label for the legend in its middle: settings that differ are at its end."""
    half = _LONGEST_LABEL // 2
    return label if len(label) <= _LONGEST_LABEL else f"{label[:half]} … {label[-half:]}"
