"""Tables and curves of a report as HTML."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = ["Curve", "Table", "paragraphs", "table_html"]

_NUMBER = re.compile(r"[–-]?|[+−-]?[\d.,\s]+(e[+-]?\d+)?\s*[%°×]?", re.IGNORECASE)
_STRONG = 0.5


@dataclass(frozen=True)
class Table:
    """A table; columns of numbers are aligned to the right.

    Attributes:
        title: Above it.
        header: One name a column.
        rows: As many cells each; the first names the row.
        note: A line below the title.
        shades: Of 0 to 1, for every row those of its cells after the first: a heat map.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    shades: Sequence[Sequence[float]] | None = None


@dataclass(frozen=True)
class Curve:
    """Lines over one axis.

    Attributes:
        title: Above them.
        y_label: What is drawn, with its unit.
        x: Of the points of all lines, ascending.
        series: Values by name, as many as `x` each; what is not finite leaves a gap.
        x_label: What `x` counts.
    """

    title: str
    y_label: str
    x: Sequence[float]
    series: Mapping[str, Sequence[float]]
    x_label: str = "epoch"


def paragraphs(lines: Sequence[str]) -> str:
    """Lines of text as HTML.

    Args:
        lines: One a paragraph.
    """
    return "\n".join(f"<p>{html.escape(line)}</p>" for line in lines)


def table_html(table: Table) -> str:
    """A table as HTML.

    Args:
        table: The table.
    """
    title, note = html.escape(table.title), html.escape(table.note)
    numeric = [_is_numeric(column) for column in zip(*table.rows, strict=True)]
    numeric = numeric or [False] * len(table.header)
    header = "".join(
        f'<th{_class("number" if right else "")} scope="col"><span>{html.escape(name)}</span></th>'
        for name, right in zip(table.header, numeric, strict=True)
    )
    shades = [None] * len(table.rows) if table.shades is None else table.shades
    rows = "\n".join(
        _row(row, numeric, shade) for row, shade in zip(table.rows, shades, strict=True)
    )
    lines = [
        '<section class="card">',
        f"<h2>{title}</h2>",
        f'<p class="note">{note}</p>' if note else "",
        # Focus, so that keys can scroll it.
        f'<div class="wide" tabindex="0" role="region" aria-label="{title}">',
        f"<table{_class('' if table.shades is None else 'heat')}>",
        f"<thead><tr>{header}</tr></thead>\n<tbody>\n{rows}\n</tbody></table></div></section>",
    ]
    return "\n".join(filter(None, lines))


def _row(cells: Sequence[str], numeric: Sequence[bool], shades: Sequence[float] | None) -> str:
    parts = [f'<th scope="row">{html.escape(cells[0])}</th>']
    for k, (cell, right) in enumerate(zip(cells[1:], numeric[1:], strict=True)):
        if shades is not None:
            strong = _class("strong" if shades[k] > _STRONG else "")
            parts.append(f'<td{strong} style="--share:{shades[k]:.3f}">{html.escape(cell)}</td>')
        else:
            parts.append(f"<td{_class('number' if right else '')}>{html.escape(cell)}</td>")
    return f"<tr>{''.join(parts)}</tr>"


def _class(name: str) -> str:
    return f' class="{name}"' if name else ""


def _is_numeric(cells: Sequence[str]) -> bool:
    return any(cells) and all(_NUMBER.fullmatch(cell.strip()) for cell in cells)
