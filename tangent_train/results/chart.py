"""Charts: bars of scores, confusion matrices, and the style that all charts share."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import ArrayLike, NDArray

from tangent_train.results.record import SCORES
from tangent_train.results.rows import Row, Statistic

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["COLORS", "confusion_picture", "png_bytes", "report_png", "row_shares"]

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999")
"""Okabe and Ito's colours, which people with colour blindness can tell apart."""

_LONGEST_LABEL = 60
_CELL_IN = 0.34
"""Side of a square of a confusion matrix in inches: room for two digits."""
_SMALL_CELL_IN = 0.12
_MOST_NUMBERED = 40
"""Of more classes the squares are smaller and without numbers."""


def report_png(title: str, rows: Sequence[Row], software: str) -> bytes:
    """Bars of the means over the classes and of every class, lines over the latitude.

    Error bars are the standard deviation over folds, else over seeds; hatched bars are published.

    Args:
        title: Of the chart.
        rows: Of one kind and with the same classes.
        software: Stands in the file.

    Returns:
        A PNG file.
    """
    scores, names = SCORES[rows[0].records[0].kind], rows[0].records[0].class_names
    banded = [row for row in rows if row.bands]
    panels = 2 + bool(banded)
    width = max(10.0, 0.12 * len(names) * len(rows))
    figure = Figure(figsize=(width, 3.6 * panels + 0.2 * len(rows)), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    means, classes, *latitude = figure.subplots(panels, 1)
    means.set_title(f"{title} (± standard deviation over folds, else over seeds)", loc="left")
    _bars(
        means, rows, list(scores.means.values()), [[r.score(n) for n in scores.means] for r in rows]
    )
    classes.set_title(f"{scores.per_class[scores.worst]} of each class", loc="left")
    _bars(classes, rows, names, [[r.score(scores.worst, name) for name in names] for r in rows])
    for axes in latitude:
        axes.set_title("mIoU by latitude", loc="left")
        _band_lines(axes, banded)
    handles, labels = means.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", frameon=False, ncols=2)
    return png_bytes(figure, software)


def _bars(
    axes: Axes, rows: Sequence[Row], ticks: Sequence[str], scores: Sequence[Sequence[Statistic]]
) -> None:
    width = 0.8 / len(rows)
    names = list(dict.fromkeys(row.label.removesuffix(" (paper)") for row in rows))
    for k, (row, found) in enumerate(zip(rows, scores, strict=True)):
        spreads = [s.over_seeds if s.over_folds is None else s.over_folds for s in found]
        axes.bar(
            np.arange(len(ticks)) + (k - (len(rows) - 1) / 2) * width,
            _percents([score.mean for score in found]),
            0.92 * width,
            yerr=_percents(spreads),
            color=COLORS[names.index(row.label.removesuffix(" (paper)")) % len(COLORS)],
            hatch="//" if row.published else "",
            label=_short(row.label),
            error_kw={"elinewidth": 1.2, "capsize": min(4.0, 14 * width), "ecolor": "#333333"},
        )
    axes.set_xticks(np.arange(len(ticks)), ticks)
    _percent_axis(axes)


def _band_lines(axes: Axes, rows: Sequence[Row]) -> None:
    for k, row in enumerate(rows):
        bands = sorted(row.bands)
        centers = [(south + north) / 2 for south, north in bands]
        shares = _percents([row.score("miou", band).mean for band in bands])
        axes.plot(centers, shares, color=COLORS[k % len(COLORS)], marker=".", label=row.label)
    axes.set_xticks(range(-90, 91, 30), [f"{k}°" for k in range(-90, 91, 30)])
    axes.legend(frameon=False, fontsize=8)
    _percent_axis(axes)
    axes.set_xlim(-90, 90)


def _percents(shares: Sequence[float | None]) -> list[float]:
    """Shares of 1 in percent; NaN, which draws nothing, for None."""
    return [np.nan if share is None else 100 * share for share in shares]


def _percent_axis(axes: Axes) -> None:
    axes.set_ylim(0, 105)
    axes.set_ylabel("%")
    axes.margins(x=0.01)
    axes.grid(axis="y", color="#dddddd")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _short(label: str) -> str:
    """A label for the legend; its end, where settings differ, matters more than its middle."""
    half = _LONGEST_LABEL // 2
    return label if len(label) <= _LONGEST_LABEL else f"{label[:half]} … {label[-half:]}"


def png_bytes(figure: Figure, software: str) -> bytes:
    """A chart as a PNG file.

    Args:
        figure: With a canvas.
        software: Stands in the file.
    """
    _plain_texts(figure)
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": software})
    return file.getvalue()


def _plain_texts(figure: Figure) -> None:
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # "$" in a name is no formula


def row_shares(confusion: ArrayLike, *, unknown: bool = True) -> NDArray[np.float64]:
    """A confusion matrix as shares of its rows.

    Args:
        confusion: Counts or weights, rows truth, columns prediction: ``(K+1, K+1)`` with the
            unknown class first, or ``(K, K)`` without.
        unknown: Whether there is an unknown class.

    Returns:
        ``(K, K)`` without the unknown class; NaN in rows of classes without labels.
    """
    first = int(unknown)
    rows = np.asarray(confusion, np.float64)[first:]
    total = rows.sum(axis=1, keepdims=True)
    shares: NDArray[np.float64] = np.full((len(rows), len(rows)), np.nan)
    np.divide(rows[:, first:], total, out=shares, where=total > 0)
    return shares


def confusion_picture(
    confusion: ArrayLike, class_names: Sequence[str], *, unknown: bool = True
) -> NDArray[np.uint8]:
    """A confusion matrix in percent of the true class, its numbers rounded to whole percents.

    Numbers that round to 0 are left out, as are all of more than 40 classes; rows of classes
    without labels are grey.

    Args:
        confusion: As in `row_shares`.
        class_names: As many names as it has rows.
        unknown: Whether the first one is the unknown class.

    Returns:
        RGB image, as large as its classes need.
    """
    shares, names = row_shares(confusion, unknown=unknown), class_names[int(unknown) :]
    numbered = len(names) <= _MOST_NUMBERED
    side = (_CELL_IN if numbered else _SMALL_CELL_IN) * len(names)
    margin = 0.5 + 0.075 * max(map(len, names))  # inches for the longest name
    width, height = max(margin + side + 0.15, 2.5), margin + side + 0.4
    figure = Figure(figsize=(width, height), dpi=100)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((margin / width, 0.4 / height, side / width, side / height))
    axes.set_facecolor("#cccccc")  # seen through NaN
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    font = 8 if numbered else 6
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=font)
    axes.set_yticks(range(len(names)), names, fontsize=font)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    edges, end = np.arange(1, len(names)) - 0.5, len(names) - 0.5
    axes.hlines(edges, -0.5, end, colors="white", linewidth=0.6)
    axes.vlines(edges, -0.5, end, colors="white", linewidth=0.6)
    axes.set_ylabel("truth", fontsize=9)
    axes.set_xlabel("prediction, % of the true class", fontsize=9, loc="left")
    percents = np.rint(100 * np.nan_to_num(shares)).astype(int)
    for row, column in np.argwhere(percents) if numbered else ():
        color = "white" if shares[row, column] > 0.5 else "black"
        text = str(percents[row, column])
        axes.text(column, row, text, ha="center", va="center", color=color, fontsize=7)
    _plain_texts(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
