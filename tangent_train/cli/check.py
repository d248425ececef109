"""``tangent-check``: all problems of a data set, in one table."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from typing import Any

from tangent_train.cli.say import say
from tangent_train.errors import counted
from tangent_train.registry import make
from tangent_train.results.tables import Table


def check(settings: Mapping[str, Any]) -> None:
    """Read the whole data set of a run; exit with status 1 if there are problems.

    On a terminal the problems are a table, elsewhere lines of file, finding and remedy with tabs
    between them; progress and the summary go to standard error then.

    Args:
        settings: The composed ``check.yaml``.
    """
    representation = make(settings["representation"], "representation")
    data = make(settings["data"], "data", representation=representation)
    terminal = sys.stdout.isatty()
    with redirect_stdout(sys.stderr):  # progress is none of the problems that are listed
        problems, count = data.check()
    listed = problems.listed()
    # Names of files may hold line ends, terminal escapes and invalid bytes.
    read = f"{counted(count, data.noun)} of {repr(str(data.root))[1:-1]} checked"
    rows = [[repr(text)[1:-1] for text in problem[:3]] for problem in listed]
    if rows and terminal:
        Table("", ("file", "finding", "remedy"), rows, text_columns=range(3), lines=True).print()
    for row in () if terminal else rows:
        sys.stdout.write("\t".join(row) + "\n")
    found = counted(len(listed), "problems") if listed else "Nothing is wrong"
    say(f"{found}; {read}.", error=bool(listed) and not terminal)
    if listed:
        sys.exit(1)
