"""Output of studies: a table in the terminal, a CSV file and a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tangent_train.files import csv_text, write_text
from tangent_train.results.tables import Table

Row = dict[str, Any]
"""A line of a table: values by column name."""

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999")
"""The palette of Okabe and Ito, which color-blind readers can distinguish."""


def save(
    name: str, rows: Sequence[Row], figure: Figure, folder: str = "figures", digits: int = 6
) -> None:
    """Save a figure ``<name>.png``, and a table as `save_table` does.

    Args:
        name: Name of the study.
        rows: See `save_table`.
        figure: Figure to save.
        folder: See `save_table`.
        digits: See `save_table`.
    """
    save_table(name, rows, folder, digits)
    figure.savefig(Path(folder) / f"{name}.png", dpi=110)


def save_table(name: str, rows: Sequence[Row], folder: str = "figures", digits: int = 6) -> None:
    """Print a Markdown table, and write ``<name>.csv``.

    Args:
        name: Name of the study.
        rows: Lines of the table, all with the same columns.
        folder: Output folder; created if missing.
        digits: Significant digits of the printed table; the CSV file contains all digits.
    """
    write_text(Path(folder) / f"{name}.csv", csv_text(list(rows[0]), rows))
    print(markdown(rows, digits))


def markdown(rows: Sequence[Row], digits: int = 6) -> str:
    """Return the table as Markdown, floats with `digits` significant digits."""
    header = list(rows[0])
    cells = [
        [f"{v:.{digits}g}" if isinstance(v, float) else str(v) for v in row.values()]
        for row in rows
    ]
    return Table("", header, cells, text_columns=range(len(header))).markdown()
