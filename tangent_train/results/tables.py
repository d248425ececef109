"""One description of a table, written as Markdown, for the terminal and as HTML."""

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
"""Characters: no table is wider."""

_LONG = 32
"""Characters: a longer cell may take several lines in HTML."""


@dataclass(frozen=True)
class Table:
    """Cells of text under a header.

    Attributes:
        title: Text above the table.
        header: One name per column.
        rows: As many cells each.
        note: Text below the table.
        text_columns: Columns that are aligned to the left; the others hold numbers.
        shades: For every row a number from 0 to 1 for each cell after the first: a heat map in
            HTML.
        lines: True if the terminal shows lines between the rows.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    text_columns: Sequence[int] = (0,)
    shades: Sequence[Sequence[float]] | None = None
    lines: bool = False

    def markdown(self) -> str:
        """The table as Markdown, below a heading."""
        rule = ["---" if k in self.text_columns else "---:" for k in range(len(self.header))]
        lines = [f"## {self.title}", ""] if self.title else []
        lines += map(markdown_line, (self.header, rule, *self.rows))
        lines += ["", self.note] if self.note else []
        return "\n".join(lines) + "\n"

    def print(self) -> None:
        """Print the table: as wide as the terminal, elsewhere as wide as it is."""
        console = Console(highlight=False)
        if not console.is_terminal:
            console.width = _WIDEST
        title, note = _shown(self.title) or None, _shown(self.note) or None
        table = rich_table.Table(title=title, caption=note, show_lines=self.lines)
        for k, name in enumerate(self.header):
            justify: Any = "left" if k in self.text_columns else "right"
            # Folded, never cut: a path is of use as a whole.
            table.add_column(_shown(name), justify=justify, overflow="fold")
        for row in self.rows:
            table.add_row(*map(_shown, row))
        console.print(table)

    def html(self) -> str:
        """The table as an HTML section."""
        title, note = html.escape(self.title), html.escape(self.note)
        kinds = ["" if k in self.text_columns else "number" for k in range(len(self.header))]
        header = "".join(
            f'<th{_class(kind)} scope="col"><span>{html.escape(name)}</span></th>'
            for name, kind in zip(self.header, kinds, strict=True)
        )
        shades = self.shades or [[]] * len(self.rows)
        rows = (_html_row(r, kinds, s) for r, s in zip(self.rows, shades, strict=True))
        # The scrolling region takes the focus, so that keys can scroll it.
        return (
            f'<section class="card">\n<h2>{title}</h2>\n<p class="note">{note}</p>\n'
            f'<div class="wide" tabindex="0" role="region" aria-label="{title}">\n'
            f"<table{_class('heat' if self.shades else '')}>\n<thead><tr>{header}</tr></thead>\n"
            f"<tbody>\n{chr(10).join(rows)}\n</tbody></table></div></section>"
        )


def _shown(text: str) -> str:
    """Text for the terminal: names of classes and files are untrusted."""
    return escape(printable(text))


def _html_row(cells: Sequence[str], kinds: Sequence[str], shades: Sequence[float]) -> str:
    first, *others = map(html.escape, cells)
    of_text = ["long" if len(text) > _LONG else "" for text in cells]
    parts = [f'<th{_class(of_text[0])} scope="row">{first}</th>']
    for k, text in enumerate(others):
        kind, style = kinds[k + 1] or of_text[k + 1], ""
        if shades:
            kind = "strong" if shades[k] > 0.5 else ""
            style = f' style="--share:{shades[k]:.3f}"'
        parts.append(f"<td{_class(kind)}{style}>{text}</td>")
    return f"<tr>{''.join(parts)}</tr>"


def _class(name: str) -> str:
    return f' class="{name}"' if name else ""


def markdown_line(cells: Sequence[str]) -> str:
    r"""One line of a Markdown table.

    >>> print(markdown_line(("a", "b|c")))
    | a | b\|c |
    """
    return "| " + " | ".join(text.replace("|", r"\|") for text in cells) + " |"


def percent(share: float | None) -> str:
    """Return a share of 1 in percent, without the sign; a dash where it is undefined."""
    return score_text(share, "%")


def score_text(value: float | None, unit: str, interval: tuple[float, float] | None = None) -> str:
    """Return a score without its unit; a dash where it is undefined.

    >>> score_text(0.4562, "%", (0.42, 0.5)), score_text(0.45623, "m"), score_text(None, "m")
    ('45.6 [42.0, 50.0]', '0.456', '–')
    """
    if value is None:
        return "–"
    ends = "" if interval is None else " [{}, {}]".format(*(score_text(v, unit) for v in interval))
    return (f"{100 * value:.1f}" if unit == "%" else f"{value:.3g}") + ends
