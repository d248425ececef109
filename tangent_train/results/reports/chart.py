"""The report over runs as a picture: bars, spread over folds, the paper's figures as marks."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas
from matplotlib.text import Text

from tangent_train.results.reports.classification import rotations
from tangent_train.results.reports.groups import Figure, Group

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["COLORS", "percents", "png_bytes", "report_png", "style_axes"]

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999")
"""Okabe and Ito's colours: told apart by people who do not see all colours."""

_LABEL_LENGTH = 60


class _Panels(NamedTuple):
    """Names of the figures that are drawn and what they are called, and the legend's columns."""

    means: Mapping[str, str]
    per_class: Mapping[str, str]
    legend_columns: int


_PANELS = {
    "segmentation": _Panels(
        {
            "miou": "mIoU",
            "macc": "mAcc",
            "miou_solid_angle": "mIoU by solid angle",
            "macc_solid_angle": "mAcc by solid angle",
        },
        {"iou": "IoU", "accuracy": "Accuracy"},
        2,
    ),
    "classification": _Panels(
        {"accuracy": "accuracy", "class_accuracy": "mean of the classes"},
        {"accuracy": "Accuracy"},
        1,
    ),
}
"""By the kind of the groups."""


def report_png(groups: Sequence[Group]) -> bytes:
    """Bars of the means, and of every class, one colour per group.

    Error bars are the standard deviation over folds, else over seeds; diamonds the paper's figures
    for the same data, resolution, base level and inputs.

    Args:
        groups: From `groups.group_runs`.

    Returns:
        A PNG file.
    """
    names, panels = groups[0].class_names, _PANELS[groups[0].kind]
    width = max(9.0, 0.75 * len(names) * max(1.0, len(groups) / 3))
    size = (width, 3.5 * (1 + len(panels.per_class)) + 0.1 * len(groups))
    figure = Canvas(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    means, *others = figure.subplots(1 + len(panels.per_class), 1)
    _bars(
        means,
        groups,
        tuple(panels.means.values()),
        [[group.figure(name) for name in panels.means] for group in groups],
        [[getattr(group.paper, name, None) for name in panels.means] for group in groups],
    )
    for axes, (name, title) in zip(others, panels.per_class.items(), strict=True):
        _bars(
            axes,
            groups,
            names,
            [[group.figure(name, k) for k in range(len(names))] for group in groups],
            [list(getattr(group.paper, name, ())) or [None] * len(names) for group in groups],
        )
        axes.set_title(f"{title} of each class", loc="left")
    means.set_title("All classes (± standard deviation over folds, else over seeds)", loc="left")
    handles, labels = means.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper left", frameon=False, ncols=panels.legend_columns
    )
    return png_bytes(figure, "tangent-report")


def png_bytes(figure: Canvas, software: str) -> bytes:
    """A picture as a PNG file.

    Args:
        figure: With a canvas.
        software: Stands in the file.
    """
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # "$" in a name is no formula
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": software})
    return file.getvalue()


def style_axes(axes: Axes) -> None:
    """Percent upwards, with light lines across."""
    axes.set_ylim(0, 105)
    axes.set_yticks(range(0, 101, 20))
    axes.set_ylabel("%")
    axes.margins(x=0.01)
    axes.grid(axis="y", color="#dddddd")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def percents(shares: Sequence[float | None]) -> list[float]:
    """Shares of 1 in percent; NaN, which draws nothing, for None."""
    return [np.nan if share is None else 100 * share for share in shares]


def _bars(
    axes: Axes,
    groups: Sequence[Group],
    ticks: Sequence[str],
    figures: Sequence[Sequence[Figure]],
    printed: Sequence[Sequence[float | None]],
) -> None:
    places = np.arange(len(ticks))
    width = 0.8 / len(groups)
    marked = False
    for k, (group, row, paper) in enumerate(zip(groups, figures, printed, strict=True)):
        at = places + (k - (len(groups) - 1) / 2) * width
        axes.bar(
            at,
            percents([figure.mean for figure in row]),
            0.92 * width,
            yerr=percents([_spread(figure) for figure in row]),
            color=COLORS[k % len(COLORS)],
            hatch=("", "//", "..")[k // len(COLORS) % 3],
            label=_short(group),
            error_kw={"elinewidth": 1.2, "capsize": min(4.0, 14 * width), "ecolor": "#333333"},
        )
        marks: Any = [np.nan if value is None else value for value in paper]
        if any(value is not None for value in paper):
            label = None if marked else "the paper (mean of 3 folds)"
            axes.plot(at, marks, "D", ms=5.5, color="white", markeredgecolor="black", label=label)
            marked = True
    axes.set_xticks(places, ticks)
    style_axes(axes)


def _spread(figure: Figure) -> float | None:
    return figure.over_seeds if figure.over_folds is None else figure.over_folds


def _short(group: Group) -> str:
    """The label for the legend; its end, where settings differ, matters more than its middle."""
    label = group.label
    if len(label) > _LABEL_LENGTH:
        label = f"{label[: _LABEL_LENGTH // 2 - 1]} … {label[1 - _LABEL_LENGTH // 2 :]}"
    folds = f"fold {', '.join(map(str, group.folds))}; " if group.folds else ""
    runs = len(group.runs)
    turned = f", {rotations(group)}" if group.kind == "classification" else ""
    return f"{group.data}{turned}: {label} ({folds}{runs} run{'s' if runs > 1 else ''})"
