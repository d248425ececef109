"""Tables that are written as Markdown, on the terminal and as HTML."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich import table as rich_table
from rich.console import Console
from rich.markup import escape

from tangent_train.errors import printable

_WIDEST = 10_000
"""Largest width of a table that is not printed on a terminal, in characters."""

_LONG = 32
"""Number of characters above which a cell may take several lines in HTML."""


@dataclass(frozen=True)
class Table:
    """Cells of text under a header.

    Attributes:
        title: Text above the table.
        header: Name of each column.
        rows: Cells of each row.
        note: Text below the table.
        text_columns: Indices of columns with text, aligned to the left; others contain numbers.
        shades: Numbers from 0 to 1 for the cells of each row after the first, for a heat map in
            HTML; None for other tables.
        lines: True to print lines between the rows on a terminal.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    text_columns: Sequence[int] = (0,)
    shades: Sequence[Sequence[float]] | None = None
    lines: bool = False

    def markdown(self) -> str:
        """Return the table as Markdown, below a heading."""
        rule = ["---" if k in self.text_columns else "---:" for k in range(len(self.header))]
        lines = [f"## {self.title}", ""] if self.title else []
        lines += map(markdown_line, (self.header, rule, *self.rows))
        lines += ["", self.note] if self.note else []
        return "\n".join(lines) + "\n"

    def print(self) -> None:
        """Print the table; on a terminal, it is folded to the terminal's width."""
        console = Console(highlight=False)
        if not console.is_terminal:
            console.width = _WIDEST
        title, note = _shown(self.title) or None, _shown(self.note) or None
        table = rich_table.Table(title=title, caption=note, show_lines=self.lines)
        for k, name in enumerate(self.header):
            justify: Any = "left" if k in self.text_columns else "right"
            # Folded, not cut: a path is useful only as a whole.
            table.add_column(_shown(name), justify=justify, overflow="fold")
        for row in self.rows:
            table.add_row(*map(_shown, row))
        console.print(table)

    def html(self) -> str:
        """Return the table as an HTML section."""
        title, note = html.escape(self.title), html.escape(self.note)
        kinds = ["" if k in self.text_columns else "number" for k in range(len(self.header))]
        header = "".join(
            f'<th{_class(kind)} scope="col"><span>{html.escape(name)}</span></th>'
            for name, kind in zip(self.header, kinds, strict=True)
        )
        shades = self.shades or [[]] * len(self.rows)
        rows = (_html_row(r, kinds, s) for r, s in zip(self.rows, shades, strict=True))
        # The scrolling region can have the focus, so that keys scroll it.
        return (
            f'<section class="card">\n<h2>{title}</h2>\n<p class="note">{note}</p>\n'
            f'<div class="wide" tabindex="0" role="region" aria-label="{title}">\n'
            f"<table{_class('heat' if self.shades else '')}>\n<thead><tr>{header}</tr></thead>\n"
            f"<tbody>\n{chr(10).join(rows)}\n</tbody></table></div></section>"
        )


def _shown(text: str) -> str:
    """Escape text for the terminal: names of classes and files are untrusted."""
    return escape(printable(text))


def _html_row(cells: Sequence[str], kinds: Sequence[str], shades: Sequence[float]) -> str:
    first, *others = map(html.escape, cells)
    lengths = ["long" if len(text) > _LONG else "" for text in cells]
    parts = [f'<th{_class(lengths[0])} scope="row">{first}</th>']
    for k, text in enumerate(others):
        kind, style = kinds[k + 1] or lengths[k + 1], ""
        if shades:
            kind = "strong" if shades[k] > 0.5 else ""
            style = f' style="--share:{shades[k]:.3f}"'
        parts.append(f"<td{_class(kind)}{style}>{text}</td>")
    return f"<tr>{''.join(parts)}</tr>"


def _class(name: str) -> str:
    return f' class="{name}"' if name else ""


def markdown_line(cells: Sequence[str]) -> str:
    r"""Return one line of a Markdown table.

    >>> print(markdown_line(("a", "b|c")))
    | a | b\|c |
    """
    return "| " + " | ".join(text.replace("|", r"\|") for text in cells) + " |"


def percent(share: float | None) -> str:
    """Return a share of 1 in percent, without the sign; a dash if it is undefined."""
    return score_text(share, "%")


def score_text(value: float | None, unit: str, interval: tuple[float, float] | None = None) -> str:
    """Return a score without its unit; a dash if it is undefined.

    >>> score_text(0.4562, "%", (0.42, 0.5)), score_text(0.45623, "m"), score_text(None, "m")
    ('45.6 [42.0, 50.0]', '0.456', '–')
    """
    if value is None:
        return "–"
    ends = "" if interval is None else " [{}, {}]".format(*(score_text(v, unit) for v in interval))
    return (f"{100 * value:.1f}" if unit == "%" else f"{value:.3g}") + ends
