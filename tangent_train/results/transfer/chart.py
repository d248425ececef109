"""The reports of a transfer as pictures."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from tangent_train.results.reports.cells import change
from tangent_train.results.reports.chart import COLORS, percents, png_bytes, style_axes
from tangent_train.results.transfer.beside_paper import printed
from tangent_train.results.transfer.cells import scope_text
from tangent_train.results.transfer.tables import MADE_BY

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

    from tangent_train.results.reports.groups import Figure
    from tangent_train.results.transfer.levels import LevelReport
    from tangent_train.results.transfer.report import Row, TransferReport

__all__ = ["levels_png", "transfer_png"]

_ERROR = {"elinewidth": 1.2, "capsize": 4.0, "ecolor": "#333333"}
_LINES = ("-", "--", ":", "-.")
_TITLES = {"miou": "mIoU", "macc": "mAcc"}


def transfer_png(report: TransferReport) -> bytes:
    """Bars of mIoU and mAcc by fine-tuning, IoU of every class, mIoU by latitude.

    Error bars are the standard deviation over seeds, dots single folds, diamonds the paper's
    figures on the same data; above the bars stands the change from photos.

    Args:
        report: From `report.gather`.

    Returns:
        A PNG file.
    """
    colors = _colors(report)
    wide = max(11.0, 0.13 * len(report.rows) * len(report.class_names))
    banded = any(row.bands for row in report.panoramas)
    heights = (5.0, 4.0, 3.6) if banded else (5.0, 4.0)
    figure = Canvas(figsize=(wide, sum(heights) + 0.9), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplot_mosaic("ia;cc;ll" if banded else "ia;cc", height_ratios=heights)
    _stage_bars(axes["i"], report, "miou", colors)
    _stage_bars(axes["a"], report, "macc", colors)
    _class_bars(axes["c"], report, colors)
    if banded:
        _band_lines(axes["l"], report, colors)
    title = f"Transfer from photos to panoramas, {scope_text(report)}"
    figure.suptitle(f"{title}\n{_marks(report)}", ha="left", x=0.01, fontsize=11)
    return png_bytes(figure, MADE_BY)


def levels_png(report: LevelReport) -> bytes:
    """Lines of mIoU and mAcc over the levels; a vertical one where the photos' resolution is.

    Error bars are the standard deviation over seeds, faint lines single folds.

    Args:
        report: From `gather_levels`.

    Returns:
        A PNG file.
    """
    figure = Canvas(figsize=(8.0, 5.0), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    levels = [row.level for row in report.rows]
    trained = f"photos in training (level {report.trained_level:g})"
    axes.axvline(report.trained_level, color="#333333", linestyle="--", label=trained)
    for name, color, marker in (("macc", COLORS[1], "s"), ("miou", COLORS[0], "o")):
        figures = [row.figure(name) for row in report.rows]
        axes.errorbar(
            levels,
            percents([found.mean for found in figures]),
            yerr=percents([found.over_seeds for found in figures]) if _any_seeds(figures) else None,
            color=color,
            marker=marker,
            capsize=4.0,
            label=_TITLES[name],
        )
        for fold in report.folds if len(report.folds) > 1 else ():
            parts = [row.of_fold(fold) for row in report.rows]
            shares = [None if part is None else part.figure(name).mean for part in parts]
            axes.plot(levels, percents(shares), color=color, alpha=0.35, linewidth=1)
    style_axes(axes)
    axes.margins(x=0.05)
    axes.set_xticks(levels)
    axes.set_xlabel("level s of the panoramas")
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(0, 1.12), ncols=3)
    return png_bytes(figure, MADE_BY)


def _marks(report: TransferReport) -> str:
    """What the marks in the upper row mean, of those that are there."""
    figures = [row.figure("miou") for row in report.rows]
    marks = ["bars: mean", "above: change from photos"]
    marks += ["error bars: standard deviation over seeds"] if _any_seeds(figures) else []
    marks += ["dots: single folds"] if len(report.folds) > 1 else []
    beside = any(printed(report, row, "miou") is not None for row in report.rows)
    return "; ".join(marks + (["diamonds: the paper"] if beside else []))


def _any_seeds(figures: Sequence[Figure]) -> bool:
    return any(figure.over_seeds is not None for figure in figures)


def _colors(report: TransferReport) -> dict[str, str]:
    """A colour for each way of seeing: photos and tangent images have the same in all reports."""
    ways = dict.fromkeys(("perspective", "tangent", "erp", "cubemap"))
    ways |= dict.fromkeys(row.kind.representation for row in report.rows)
    order = (COLORS[6], COLORS[0], COLORS[1], COLORS[2], COLORS[3], COLORS[4], COLORS[5])
    return {way: order[k % len(order)] for k, way in enumerate(ways)}


def _stage_bars(axes: Axes, report: TransferReport, name: str, colors: dict[str, str]) -> None:
    """Bars of all classes' mean, one group for each number of epochs of fine-tuning."""
    groups: dict[int, list[Row]] = defaultdict(list)
    for row in report.rows:
        groups[row.kind.epochs].append(row)
    at, ticks = 0.0, []
    for rows in groups.values():
        for row in rows:
            _stage_bar(axes, report, row, name, at, colors[row.kind.representation])
            ticks.append((at, row.name))
            at += 1.0
        at += 0.6
    places, names = zip(*ticks, strict=True)
    crowded = len(ticks) > 6
    axes.set_xticks(
        places, names, rotation=40 if crowded else 0, ha="right" if crowded else "center"
    )
    style_axes(axes)
    axes.margins(x=0.03)
    axes.set_title(_TITLES[name], loc="left")


def _stage_bar(
    axes: Axes, report: TransferReport, row: Row, name: str, at: float, color: str
) -> None:
    found = row.figure(name)
    (height,) = percents([found.mean])
    spread = 0.0 if found.over_seeds is None else 100 * found.over_seeds
    axes.bar(at, height, 0.86, yerr=spread or None, color=color, error_kw=_ERROR)
    parts = [row.of_fold(fold) for fold in row.folds] if len(row.folds) > 1 else []
    folds = percents([part.figure(name).mean for part in parts if part is not None])
    axes.plot([at] * len(folds), folds, ".", ms=7, color="white", markeredgecolor="#333333")
    beside = percents([printed(report, row, name)])
    axes.plot([at], beside, "D", ms=5.5, color="white", markeredgecolor="black")
    kept = row.kept(name).mean
    if kept is not None:
        top = max(value for value in (height + spread, *folds, *beside) if not np.isnan(value))
        axes.annotate(
            change(kept), (at, top), (0, 8), textcoords="offset points", ha="center", fontsize=8
        )


def _class_bars(axes: Axes, report: TransferReport, colors: dict[str, str]) -> None:
    """Bars of every class's IoU; more fine-tuning is paler."""
    places = np.arange(len(report.class_names))
    width = 0.84 / len(report.rows)
    for k, row in enumerate(report.rows):
        axes.bar(
            places + (k - (len(report.rows) - 1) / 2) * width,
            percents([row.figure("iou", c).mean for c in range(len(report.class_names))]),
            width,
            color=colors[row.kind.representation],
            alpha=1 / (1 + 0.6 * _tuning(report, row)),
            label=row.name,
        )
    axes.set_xticks(places, report.class_names)
    style_axes(axes)
    axes.set_title("IoU of each class", loc="left")
    axes.legend(frameon=False, ncols=8, loc="upper right", bbox_to_anchor=(1, 1.13), fontsize=8)


def _band_lines(axes: Axes, report: TransferReport, colors: dict[str, str]) -> None:
    """Lines of mIoU from pole to pole."""
    for row in report.panoramas:
        bands = sorted(row.bands)
        axes.plot(
            [(south + north) / 2 for south, north in bands],
            percents([row.figure("miou", band=band).mean for band in bands]),
            color=colors[row.kind.representation],
            linestyle=_LINES[_tuning(report, row) % len(_LINES)],
            marker=".",
            label=row.name,
        )
    style_axes(axes)
    axes.set_xlim(-90, 90)
    axes.set_xticks(range(-90, 91, 15), [f"{k}°".replace("-", "−") for k in range(-90, 91, 15)])
    axes.set_title("mIoU by latitude (centres of bands)", loc="left")
    axes.legend(frameon=False, ncols=8, loc="upper right", bbox_to_anchor=(1, 1.15), fontsize=8)


def _tuning(report: TransferReport, row: Row) -> int:
    """Which of the numbers of epochs of fine-tuning it is."""
    return sorted({other.kind.epochs for other in report.rows}).index(row.kind.epochs)
