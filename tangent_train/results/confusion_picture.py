"""A confusion matrix as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import ArrayLike, NDArray

__all__ = ["confusion_picture", "row_shares"]

_DPI = 100
_CELL_IN = 0.34
"""Side of a class's square in inches, for two digits of `_FONT_PT`."""

_SMALL_CELL_IN = 0.12
_MOST_NUMBERED = 40
"""Of more classes the squares are smaller and without numbers."""

_FONT_PT = 8.0
_LETTER_IN = 0.075
_LEAST_IN = 2.5
_DARK = 0.5


def row_shares(confusion: ArrayLike, *, unknown: bool = True) -> NDArray[np.float64]:
    """Where what is labelled went, of every class.

    Args:
        confusion: Counts or weights, rows truth, columns prediction: ``(K+1, K+1)`` with the
            unknown class first, or ``(K, K)`` without.
        unknown: Whether there is an unknown class.

    Returns:
        ``(K, K)`` shares of 1 of the rows, without the unknown class; NaN in rows of classes that
        nothing is labelled with.
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
    """Where every class went: a row per true class, percent of what it has.

    Numbers are whole percents, of up to 40 classes; what rounds to 0 is left out, rows of classes
    that nothing is labelled with are grey.

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
    font = _FONT_PT if numbered else _FONT_PT - 2
    margin = 0.5 + _LETTER_IN * max(map(len, names))
    right, bottom = 0.15, 0.4
    width, height = max(margin + side + right, _LEAST_IN), margin + side + bottom
    figure = Figure(figsize=(width, height), dpi=_DPI)
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_axes((margin / width, bottom / height, side / width, side / height))
    axes.set_facecolor("#cccccc")  # seen through NaN
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    places = range(len(names))
    axes.set_xticks(places, names, rotation=90, fontsize=font)
    axes.set_yticks(places, names, fontsize=font)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    edges, end = np.arange(1, len(names)) - 0.5, len(names) - 0.5
    axes.hlines(edges, -0.5, end, colors="white", linewidth=0.6)
    axes.vlines(edges, -0.5, end, colors="white", linewidth=0.6)
    axes.set_ylabel("truth", fontsize=_FONT_PT + 1)
    axes.set_xlabel("prediction, % of the true class", fontsize=_FONT_PT + 1, loc="left")
    percents = np.rint(100 * np.nan_to_num(shares)).astype(int)
    for row, column in np.argwhere(percents) if numbered else ():
        color = "white" if shares[row, column] > _DARK else "black"
        text = str(percents[row, column])
        axes.text(column, row, text, ha="center", va="center", color=color, fontsize=_FONT_PT - 1)
    for name in figure.findobj(Text):
        name.set_parse_math(False)  # "$" in a name is no formula
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
