"""Output of studies: a table in the terminal, a CSV file and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tangent_train.files import csv_text, write_text
from tangent_train.results.tables import Table

FOLDER = Path("figures")

Row = dict[str, Any]
"""A line of a table: values by column name."""


def save(name: str, rows: Sequence[Row], figure: Figure | None = None, digits: int = 6) -> None:
    """Print a Markdown table; write ``figures/<name>.csv``, and ``.png`` with a figure.

    Args:
        name: Name of the study.
        rows: Lines of the table, all with the same columns.
        figure: Figure to save.
        digits: Significant digits of the printed table; the CSV file contains all digits.
    """
    write_text(FOLDER / f"{name}.csv", csv_text(list(rows[0]), rows))
    print(markdown(rows, digits))
    if figure is not None:
        figure.savefig(FOLDER / f"{name}.png", dpi=110)


def markdown(rows: Sequence[Row], digits: int = 6) -> str:
    """Return the table as Markdown, floats with `digits` significant digits."""
    header = list(rows[0])
    cells = [
        [f"{v:.{digits}g}" if isinstance(v, float) else str(v) for v in row.values()]
        for row in rows
    ]
    return Table("", header, cells, text_columns=range(len(header))).markdown()
