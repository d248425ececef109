"""``tangent-check``: all problems of a data set, in one table."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from datamodules.core.problems import Problem
from tangent_train.cli.say import say
from tangent_train.errors import counted
from tangent_train.registry import make


def check(settings: Mapping[str, Any]) -> None:
    """Read the whole data set of a run; exit with status 1 if there are problems.

    On a terminal the problems are a table, elsewhere lines of file, finding and remedy with tabs
    between them; progress and the summary go to standard error then.

    Args:
        settings: The composed ``check.yaml``.
    """
    representation = make(settings["representation"], "representation")
    data = make(settings["data"], "data", representation=representation)
    console = Console(highlight=False)
    with redirect_stdout(sys.stderr):  # progress is none of the problems that are listed
        problems, count = data.check()
    listed = problems.listed()
    read = f"{counted(count, data.noun)} of {_printable(str(data.root))} checked"
    if listed and console.is_terminal:
        console.print(_table(listed))
    for problem in () if console.is_terminal else listed:
        sys.stdout.write("\t".join(map(_printable, problem[:3])) + "\n")
    found = counted(len(listed), "problems") if listed else "Nothing is wrong"
    say(f"{found}; {read}.", error=bool(listed) and not console.is_terminal)
    if listed:
        sys.exit(1)


def _table(problems: Sequence[Problem]) -> Table:
    table = Table(show_lines=True)
    # Folded, never cut: a path is of use as a whole.
    table.add_column("file", overflow="fold", ratio=4)
    table.add_column("finding", overflow="fold", ratio=3)
    table.add_column("remedy", overflow="fold", ratio=3)
    for problem in problems:
        table.add_row(*(Text(_printable(cell)) for cell in problem[:3]))
    return table


def _printable(text: str) -> str:
    r"""Escape file names, which may hold line ends, terminal escapes and invalid bytes.

    >>> print(_printable("küche 1\n\x1b[2J\udcff.png"))
    küche 1\n\x1b[2J\udcff.png
    """
    escaped = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return "".join(escaped)
