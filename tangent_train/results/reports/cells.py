"""Cells of the reports' tables: figures as text, Markdown, tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from tangent_train.results.reports.groups import Figure

__all__ = [
    "Cells",
    "cell",
    "change",
    "kept",
    "line",
    "markdown_table",
    "percent",
    "terminal_table",
    "text",
]

Cells = tuple[str, ...]
"""A row of a table."""


def text(value: object) -> str:
    """A value, or a dash where there is none."""
    return "–" if value is None else str(value)


def percent(share: float | None) -> str:
    """A share of 1 in percent, without the sign.

    >>> percent(0.4562)
    '45.6'
    """
    return "–" if share is None else f"{100 * share:.1f}"


def cell(figure: Figure, folds: int) -> str:
    """A figure in percent with its spreads.

    Args:
        figure: Mean and spreads.
        folds: How many it should be over; another number is said.

    >>> cell(Figure(0.5, 0.041, 0.012, 2), 3)
    '50.0 ± 4.1 (± 1.2) of 2'
    """
    if figure.mean is None:
        return "–"
    lacking = f" of {figure.folds}" if figure.folds < folds else ""
    return percent(figure.mean) + _spreads(figure) + lacking


def kept(figure: Figure) -> str:
    """What is kept of another figure, with its spreads.

    >>> kept(Figure(0.9554, 0.021, None, 3))
    '95.5 % ± 2.1'
    """
    return "–" if figure.mean is None else f"{percent(figure.mean)} %{_spreads(figure)}"


def change(share: float | None) -> str:
    """What is kept of another figure, as a change.

    >>> change(0.955), change(1.026), change(0.9999)
    ('−4.5 %', '+2.6 %', '+0.0 %')
    """
    if share is None:
        return "–"
    rounded = round(100 * (share - 1), 1) + 0.0  # no −0.0
    return f"{rounded:+.1f} %".replace("-", "−")


def markdown_table(rows: Sequence[Cells], left: int) -> list[str]:
    """Lines of a Markdown table.

    Args:
        rows: The first is the header.
        left: How many columns are text.
    """
    header, *others = rows
    rule = ["---" if k < left else "---:" for k in range(len(header))]
    return [line(cells) for cells in (header, rule, *others)]


def line(cells: Sequence[str]) -> str:
    r"""One line of a Markdown table.

    >>> print(line(("a", "b|c")))
    | a | b\|c |
    """
    return "| " + " | ".join(found.replace("|", r"\|") for found in cells) + " |"


def terminal_table(
    title: str, rows: Sequence[Cells], left: Sequence[int], caption: str = ""
) -> Table:
    """A table for the terminal.

    Args:
        title: Stands above.
        rows: The first is the header.
        left: Which columns are text.
        caption: Stands below.
    """
    table = Table(title=escape(title), caption=escape(caption) or None)
    header, *others = rows
    for k, name in enumerate(header):
        table.add_column(escape(name), justify="left" if k in left else "right")
    for row in others:
        paper = any(name.endswith("(paper)") for name in row[:2])
        table.add_row(*map(escape, row), style="dim" if paper else None)
    return table


def _spreads(figure: Figure) -> str:
    folds = "" if figure.over_folds is None else f" ± {percent(figure.over_folds)}"
    seeds = "" if figure.over_seeds is None else f" (± {percent(figure.over_seeds)})"
    return folds + seeds
