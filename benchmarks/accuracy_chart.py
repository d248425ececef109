"""What ``python -m benchmarks accuracy`` found, as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.accuracy_rows import ORIENTATIONS, PLAIN
from benchmarks.accuracy_table import TURNED, UPRIGHT
from tangent_train.tasks.reports.chart import COLORS, png_bytes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

    from benchmarks.accuracy_table import Line

__all__ = ["accuracy_png"]

_MARKS = {UPRIGHT: (COLORS[0], "o"), TURNED: (COLORS[5], "D")}
_LINE_INCHES = 0.25


def accuracy_png(lines: Sequence[Line], title: str) -> bytes:
    """A line for every line of the table, the best first: dots with their spread over the seeds.

    Networks trained upright and those trained on turned panoramas stand apart; dots are hollow
    where the images are equirectangular.

    Args:
        lines: From `found_lines`, one at least.
        title: Above.

    Returns:
        A PNG file.
    """
    groups = {
        "trained upright": [line for line in lines if not line.row.turned],
        "trained turned any way": [line for line in lines if line.row.turned],
    }
    groups = {name: _sorted(found) for name, found in groups.items() if found}
    heights = [len(found) + 1 for found in groups.values()]
    size = (9.0, 1.4 + _LINE_INCHES * sum(heights))
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    all_axes = figure.subplots(
        len(groups), 1, sharex=True, squeeze=False, height_ratios=heights
    ).ravel()
    for axes, (name, found) in zip(all_axes, groups.items(), strict=True):
        _draw(axes, found)
        axes.set_title(name, loc="left", fontsize=10)
    all_axes[-1].set_xlabel("mIoU in percent")
    for orientation, (color, marker) in _MARKS.items():
        all_axes[0].plot([], [], marker, color=color, label=f"tested {ORIENTATIONS[orientation]}")
    all_axes[0].plot([], [], "o", mfc="white", mec="#333333", label="equirectangular images")
    figure.legend(loc="outside upper right", ncols=3, frameon=False, fontsize=9)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    return png_bytes(figure, "benchmarks accuracy")


def _sorted(lines: Sequence[Line]) -> list[Line]:
    return sorted(lines, key=lambda line: -(line.mean(UPRIGHT) or line.mean(TURNED) or 0))


def _draw(axes: Axes, lines: Sequence[Line]) -> None:
    for place, line in enumerate(lines):
        means = [mean for name in _MARKS if (mean := line.mean(name)) is not None]
        if means:
            axes.hlines(place, 100 * min(means), 100 * max(means), color="#dddddd", zorder=1)
        for orientation, (color, marker) in _MARKS.items():
            mean = line.mean(orientation)
            if mean is not None:
                axes.errorbar(
                    100 * mean,
                    place,
                    xerr=100 * (line.spread(orientation) or 0),
                    fmt=marker,
                    color=color,
                    mfc="white" if line.row.equirect else color,
                    ms=5.5,
                    elinewidth=1.3,
                    capsize=2.5,
                )
    axes.set_yticks(range(len(lines)), [line.name for line in lines], fontsize=9)
    for label, line in zip(axes.get_yticklabels(), lines, strict=True):
        label.set_color("black" if line.variant is PLAIN else "#777777")
    axes.set_ylim(len(lines) - 0.4, -0.6)
    axes.grid(axis="x", color="#eeeeee")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
