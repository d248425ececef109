"""What a study hands back: figures as CSV and as a table, a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Canvas

from tangent_train.csv_text import csv_text
from tangent_train.results.reports.cells import Cells, terminal_table, text
from tangent_train.results.reports.chart import png_bytes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.table import Table

__all__ = ["MADE_BY", "Column", "Outcome", "canvas", "parts", "plain", "png", "style"]

MADE_BY = "tangent-study"
"""Stands in the pictures: the mark of a study."""


@dataclass(frozen=True)
class Column:
    """A column of figures.

    Attributes:
        key: Its name in the CSV file.
        heading: Its name in the table; without one it stands in the file alone.
        form: How the table formats it, with the unit, as in ``.2f`` or ``.2f°``.
    """

    key: str
    heading: str = ""
    form: str = ""

    def show(self, value: object) -> str:
        """A value as the table has it.

        >>> Column("angle", "angle", ".1f°").show(16.83), Column("angle").show(None)
        ('16.8°', '–')
        """
        if value is None or isinstance(value, str):
            return text(value)
        form = self.form.rstrip("° %")
        return format(value, form) + self.form[len(form) :]


@dataclass(frozen=True)
class Outcome:
    """Figures of a study.

    Attributes:
        title: Stands above the table.
        columns: The first is text.
        rows: A value for each column; None where there is none.
        notes: Sentences that have to be known beside the figures.
        png: The picture, a PNG file.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Any]]
    notes: Sequence[str]
    png: bytes

    def csv(self) -> str:
        """All columns with all digits; nothing where there is no value."""
        return csv_text([column.key for column in self.columns], self.rows)

    def cells(self) -> list[Cells]:
        """The table as text, its header first."""
        shown = [k for k, column in enumerate(self.columns) if column.heading]
        header = tuple(self.columns[k].heading for k in shown)
        body = [tuple(self.columns[k].show(row[k]) for k in shown) for row in self.rows]
        return [header, *body]

    def table(self) -> Table:
        """The table for the terminal."""
        return terminal_table(self.title, self.cells(), (0,))


def canvas(width: float, height: float) -> Canvas:
    """An empty picture, its size in inches."""
    figure = Canvas(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def parts(figure: Canvas, heights: tuple[float, float]) -> tuple[Any, Any]:
    """The upper and the lower part of a picture, by relative heights."""
    upper, lower = np.atleast_1d(np.array(figure.subfigures(2, 1, height_ratios=heights)))
    return upper, lower


def plain(value: float, _place: float) -> str:
    """A number on a logarithmic axis, without the powers that need fonts for formulas.

    >>> plain(1e-5, 0), plain(100.0, 0)
    ('0.00001', '100')
    """
    return f"{value:.9f}".rstrip("0").rstrip(".")


def png(figure: Canvas) -> bytes:
    """The picture as a file, with the mark of a study."""
    return png_bytes(figure, MADE_BY)


def style(axes: Axes, title: str, x: str, y: str) -> None:
    """Titles, light lines, no frame."""
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color="#dddddd")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
