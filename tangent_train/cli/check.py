"""``tangent-check``: list all problems of a data set."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout

from datamodules.core.label_map import label_doubts
from tangent_train.cli import main
from tangent_train.cli.run import open_data
from tangent_train.cli.scored_files import check_files
from tangent_train.config.settings import FilesSettings
from tangent_train.console import print_text
from tangent_train.errors import counted
from tangent_train.io.pixel_files import has_warned_of_range
from tangent_train.results.tables import Table, percent


def check(settings: FilesSettings) -> None:
    """Read the whole data set of a run, or predictions; exit with 1 if there are problems.

    On a terminal, the problems are printed as a table. Elsewhere they are lines of file, finding
    and remedy, separated by tabs; everything else then goes to standard error.

    Args:
        settings: Settings of the command.
    """
    if settings.predictions is not None:
        if not check_files(settings):
            sys.exit(1)
        return
    data = open_data(settings)
    terminal = sys.stdout.isatty()
    with redirect_stdout(sys.stderr):  # where progress is printed
        problems, count = data.check()
    listed = problems.listed()
    # Names of files may contain line ends, terminal escapes and invalid bytes.
    checked = f"{counted(count, data.noun)} of {repr(str(data.root))[1:-1]} checked"
    rows = [[repr(text)[1:-1] for text in problem[:3]] for problem in listed]
    if rows and terminal:
        Table("", ("file", "finding", "remedy"), rows, text_columns=range(3), lines=True).print()
    for row in () if terminal else rows:
        sys.stdout.write("\t".join(row) + "\n")
    labeled = {split: counts for split, counts in data.label_counts.items() if counts.any()}
    warnings = sorted(problems.warnings) + [
        doubt
        for split, counts in labeled.items()
        for doubt in label_doubts(split, counts, data.label_names)
    ]
    warnings += ["16-bit colors of few bits, which are named above"] * has_warned_of_range()
    with redirect_stdout(sys.stdout if terminal else sys.stderr):
        if labeled:
            shares = [[percent(share) for share in n / n.sum()] for n in labeled.values()]
            rows = [[*row] for row in zip(data.label_names, *shares, strict=True)]
            kind = "class" if data.class_names else "label"
            Table(f"Pixels of each {kind}, %", [kind, *labeled], rows).print()
        for warning in warnings:
            print_text(f"Warning: {warning}", error=not terminal)
    summary = counted(len(listed), "problems") if listed else "Nothing is wrong"
    if warnings:
        summary = f"{counted(len(listed), 'problems')} and {counted(len(warnings), 'warnings')}"
    print_text(f"{summary}; {checked}.", error=bool(listed or warnings) and not terminal)
    if listed:
        sys.exit(1)


if __name__ == "__main__":
    main.check()
