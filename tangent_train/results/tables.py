"""Tables that are written as Markdown, on the terminal and as HTML."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from rich import table as rich_table
from rich.cells import cell_len
from rich.console import Console
from rich.text import Text

from tangent_train.console import log_text
from tangent_train.errors import printable

_WIDTH = 100
"""Width of a table that is not printed on a terminal, in characters, unless a word needs more."""

_MOST_ROWS = 20
"""Printed rows of classes."""

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
        shares: Shares of the first rows, of which only the largest are printed.
        file: File with all rows.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    text_columns: Sequence[int] = (0,)
    shades: Sequence[Sequence[float]] | None = None
    lines: bool = False
    shares: Sequence[float] = ()
    file: str = ""

    def markdown(self) -> str:
        """Return the table as Markdown, below a heading."""
        rule = ["---" if k in self.text_columns else "---:" for k in range(len(self.header))]
        rows = [[*map(markdown_text, row)] for row in (self.header, *self.rows)]
        rows.insert(1, rule)
        lines = [f"## {markdown_text(self.title)}", ""] if self.title else []
        lines += [f"| {' | '.join(row)} |" for row in rows]
        lines += ["", markdown_text(self.note)] if self.note else []
        return "\n".join(lines) + "\n"

    def print(self) -> None:
        """Print the table, folded to the width of the terminal; of many classes, the largest."""
        log_text(self.markdown())
        console, rows = Console(highlight=False), [*self.rows]
        if (more := len(self.shares) - _MOST_ROWS) > 0:
            order = sorted(range(len(self.shares)), key=self.shares.__getitem__, reverse=True)
            rows = [rows[k] for k in order[:_MOST_ROWS]] + rows[len(order) :]
            rows.insert(_MOST_ROWS, [f"… {more} more in {self.file}", *[""] * len(self.header[1:])])
        columns = [*zip(self.header, *rows, strict=True)]
        longest = [0] * len(columns)
        if not console.is_terminal:  # whole words: a part of a path is useless
            longest = [max(map(cell_len, " ".join(c).split()), default=0) for c in columns]
            console.width = max(_WIDTH, sum(longest) + 3 * len(columns) + 1)
        if sum(max(map(len, column)) + 3 for column in columns) >= console.width:
            rows = [[cell.replace(" [", "\n[") for cell in row] for row in rows]  # intervals
        title, note = (_shown(text) if text else None for text in (self.title, self.note))
        table = rich_table.Table(title=title, caption=note, show_lines=self.lines)
        for k, (name, least) in enumerate(zip(self.header, longest, strict=True)):
            justify: Any = "left" if k in self.text_columns else "right"
            table.add_column(_shown(name), justify=justify, overflow="fold", min_width=least)
        for row in rows:
            table.add_row(*map(_shown, row))
        console.print(table)

    def html(self) -> str:
        """Return the table as an HTML section."""
        title, css = escape(self.title), ' class="heat"' if self.shades else ""
        header = "".join(
            f'<th class="{self._css(k)}" scope="col"><span>{escape(name)}</span></th>'
            for k, name in enumerate(self.header)
        )
        rows = "\n".join(map(self._html_row, self.rows, self.shades or [()] * len(self.rows)))
        # The scrolling region can have the focus, so that keys scroll it.
        return (
            f'<section class="card">\n<h2>{title}</h2>\n<p class="note">{escape(self.note)}</p>\n'
            f'<div class="wide" tabindex="0" role="region" aria-label="{title}">\n'
            f"<table{css}>\n<thead><tr>{header}</tr></thead>\n"
            f"<tbody>\n{rows}\n</tbody></table></div></section>"
        )

    def _html_row(self, cells: Sequence[str], shades: Sequence[float]) -> str:
        parts = [f'<th class="{self._css(0, cells[0])}" scope="row">{escape(cells[0])}</th>']
        for k, text in enumerate(cells[1:], start=1):
            css, style = self._css(k, text), ""
            if shades:
                css = "strong" if shades[k - 1] > 0.5 else ""
                style = f' style="--share:{shades[k - 1]:.3f}"'
            parts.append(f'<td class="{css}"{style}>{escape(text)}</td>')
        return f"<tr>{''.join(parts)}</tr>"

    def _css(self, column: int, text: str = "") -> str:
        if column not in self.text_columns:
            return "number"
        return "long" if len(text) > _LONG else ""


def _shown(text: str) -> Text:
    """Return text for the terminal without markup: names of classes and files are untrusted."""
    return Text(printable(text))


def markdown_text(text: str) -> str:
    r"""Return text as Markdown of one line that shows it, without HTML, links and cells.

    Names of runs, classes and files are untrusted.

    >>> print(markdown_text("<b>sofa|[x](javascript:y)"))
    &lt;b&gt;sofa\|\[x\](javascript:y)
    """
    line = escape(" ".join(printable(text).split("\n")), quote=False)
    is_link = re.search(r"\][(\[:]", line)
    return re.sub(r"[|\\\[\]]" if is_link else r"[|\\]", r"\\\g<0>", line)


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
