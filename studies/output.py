"""Output that all studies share: a table for the terminal, a CSV file and a picture."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

__all__ = ["COLORS", "Row", "save"]

Row = dict[str, Any]
"""A line of a table: values by column name."""

COLORS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999")
"""The palette of Okabe and Ito, which colour-blind readers can tell apart."""


def save(
    name: str, rows: Sequence[Row], figure: Figure, folder: str = "figures", digits: int = 6
) -> None:
    """Print a Markdown table; write ``<name>.csv`` and ``<name>.png``.

    Args:
        name: Of the study.
        rows: Lines of the table, all with the same columns.
        figure: The picture.
        folder: Output folder; created if missing.
        digits: Significant digits of the printed table; the CSV file has all.
    """
    Path(folder).mkdir(parents=True, exist_ok=True)
    with (Path(folder) / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    figure.savefig(Path(folder) / f"{name}.png", dpi=110)
    print("\n".join(markdown(rows, digits)))


def markdown(rows: Sequence[Row], digits: int = 6) -> list[str]:
    """The lines of the table; floats with `digits` significant digits."""
    cells = [
        [f"{v:.{digits}g}" if isinstance(v, float) else str(v) for v in row.values()]
        for row in rows
    ]
    header = list(rows[0])
    return [f"| {' | '.join(line)} |" for line in (header, ["---"] * len(header), *cells)]
