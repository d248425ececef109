"""The tables of a benchmark as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from benchmarks.report import amount
from tangent_train.results.chart import COLORS, png_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

    from benchmarks.measuring import Table

__all__ = ["tables_png"]

_ROW_INCHES = 0.3
_HEAD_INCHES = 1.0
_CURVE_ROWS = 8
_MOST_BELOW_EACH_OTHER = 3
_LOGARITHMIC = 20


def tables_png(tables: Sequence[Table]) -> bytes:
    """Bars of all tables, this project's in colour; curves where rows have sizes.

    Args:
        tables: One at least.

    Returns:
        A PNG file.
    """
    columns = 1 if len(tables) <= _MOST_BELOW_EACH_OTHER else 2
    inches = [
        _HEAD_INCHES + _ROW_INCHES * (_CURVE_ROWS if _is_curve(table) else len(table.rows))
        for table in tables
    ]
    heights = [max(inches[start : start + columns]) for start in range(0, len(tables), columns)]
    figure = Figure(figsize=(9.0 * columns, sum(heights)), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    places = figure.subplots(len(heights), columns, squeeze=False, height_ratios=heights).ravel()
    for axes in places[len(tables) :]:
        axes.remove()
    for axes, table in zip(places, tables, strict=False):
        (_draw_curve if _is_curve(table) else _draw_bars)(axes, table)
        axes.set_title(table.title, loc="left", fontsize=10)
        _plain_ticks(axes, table.unit)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=9)
    return png_bytes(figure, "benchmarks")


def _plain_ticks(axes: Axes, unit: str) -> None:
    """Without formulas, whose fonts are not everywhere."""
    values = [axes.xaxis, axes.yaxis] if axes.get_yscale() == "log" else [axes.xaxis]
    for axis in values:
        axis.set_minor_formatter(NullFormatter())
        if axis is axes.xaxis and len(values) > 1:
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
        else:
            axis.set_major_formatter(FuncFormatter(lambda value, _: amount(value, unit)))


def _is_curve(table: Table) -> bool:
    return all(row.size is not None for row in table.rows)


def _draw_bars(axes: Axes, table: Table) -> None:
    """Medians, with the least and the most; logarithmic where they differ much."""
    medians = [row.median for row in table.rows]
    places = range(len(medians))
    axes.barh(places, medians, color=[COLORS[0] if row.ours else COLORS[6] for row in table.rows])
    for place, row in zip(places, table.rows, strict=True):
        axes.plot([min(row.values), max(row.values)], [place, place], color="black", lw=1)
        text = f" {amount(row.median, table.unit)}, {table.ratio(row.name).median:.3g}×"
        axes.annotate(text, (max(row.values), place), va="center", fontsize=9)
    most = max(max(row.values) for row in table.rows)
    if max(medians) > _LOGARITHMIC * min(medians):
        axes.set_xscale("log")
        axes.set_xlim(min(medians) / 2, most * 10)
    else:
        axes.set_xlim(0, most * 1.35)
    axes.set_yticks(places, [row.name for row in table.rows])
    axes.invert_yaxis()


def _draw_curve(axes: Axes, table: Table) -> None:
    """Medians over sizes beside a straight line from the last: twice the pixels, twice as much."""
    sizes = [row.size or 0.0 for row in table.rows]
    medians = [row.median for row in table.rows]
    axes.loglog(sizes, medians, "o-", color=COLORS[0])
    axes.loglog(sizes, [medians[-1] * size / sizes[-1] for size in sizes], ":", color=COLORS[6])
    for row, size in zip(table.rows, sizes, strict=True):
        axes.annotate(f"  {row.name}: {amount(row.median, table.unit)}", (size, row.median),
                      va="top", fontsize=8)  # fmt: skip
    axes.set_xlim(sizes[0] / 1.5, sizes[-1] * 6)
    axes.set_xlabel("pixels of all images (dotted: linear)", fontsize=9)
