"""``tangent-report``: compare finished runs with each other and with published scores."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from tangent_train.cli import main
from tangent_train.console import print_text


def report(arguments: Sequence[str]) -> None:
    """Read runs, print the table, and write ``report.md``, ``.csv`` and ``.png``.

    Args:
        arguments: Command line after the program's name.

    Raises:
        DataError: Runs are missing or cannot be read.
    """
    parser = argparse.ArgumentParser(
        "tangent-report",
        description="Mean and spread of scores over folds and seeds, with published scores.",
        epilog="Runs that differ only in fold and seed share a row. Example: tangent-report "
        "runs/paper/semseg_s7_b0_rgbd --output report_s7",
    )
    of_folders = "folders of runs, or folders with runs below them"
    parser.add_argument("folders", nargs="+", type=Path, help=of_folders)
    of_output = "folder for report.md, report.csv and report.png (default: report)"
    parser.add_argument("--output", type=Path, default=Path("report"), help=of_output)
    options = parser.parse_args(arguments)
    # Slow imports, not needed to refuse a command line.
    from tangent_train.results.evaluation import find_runs, load_result
    from tangent_train.results.report import runs_report

    finished, begun = find_runs(options.folders)
    notes = [f"{run}: not finished, ignored." for run in begun]
    runs = runs_report([load_result(folder) for folder in finished], notes)
    runs.write(options.output, "report")
    runs.print()
    print_text(f"Files: {options.output}/report.*")


if __name__ == "__main__":
    main.report()
