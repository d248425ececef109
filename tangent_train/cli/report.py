"""``tangent-report``: what the command line says, and the files it leaves."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from tangent_train.errors import SettingError
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["report"]

_FILES = ("report.json", "report.md", "report.csv", "report.png")


def report(arguments: Sequence[str]) -> None:
    """Read runs, print the tables, write ``report.md``, ``.csv``, ``.json`` and ``.png``.

    Args:
        arguments: The command line after the program's name.

    Raises:
        DataError: Runs are missing or cannot be read.
        SettingError: The output folder holds files of these names that are no report.
    """
    options = _parser().parse_args(arguments)
    _check_output(options.output)
    # Heavy, and not needed to say what is wrong with the command line.
    from rich.console import Console

    from tangent_train.files import write_bytes, write_text
    from tangent_train.results.reports import tables
    from tangent_train.results.reports.chart import report_png
    from tangent_train.results.reports.groups import group_runs
    from tangent_train.results.reports.runs import find_runs, load_run, unfinished_runs

    groups = group_runs([load_run(folder) for folder in find_runs(options.folders)])
    remarks = tables.notes(groups)
    remarks += [f"{run}: not finished, left out." for run in unfinished_runs(options.folders)]
    # The mark of a report first: an interrupted one can be written again.
    write_text(options.output / "report.json", tables.report_json(groups, remarks))
    write_text(options.output / "report.md", tables.report_markdown(groups, remarks))
    write_text(options.output / "report.csv", tables.report_csv(groups))
    write_bytes(options.output / "report.png", report_png(groups))
    console = Console(highlight=False)
    for table in tables.report_tables(groups):
        console.print(table)
    for remark in remarks:
        console.print(f"- {remark}", soft_wrap=True, markup=False)
    files = f"Per class, beside the paper: {options.output / 'report.md'}, .csv, .json, .png"
    console.print(files, soft_wrap=True, markup=False)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "tangent-report",
        description="Mean and spread over folds and seeds, per class, beside the paper's figures.",
        epilog="Runs that differ only in fold and seed make one row. Example: tangent-report "
        "runs/paper/semseg_s7_b0_rgbd --output report_s7",
    )
    parser.add_argument(
        "folders", nargs="+", type=Path, help="folders of runs, or folders with runs below them"
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("report"),
        metavar="FOLDER",
        help="where report.md, .csv, .json and .png are written (default: report)",
    )
    return parser


def _check_output(folder: Path) -> None:
    """Refuse to write where no folder can be, and over files that no report left there."""
    parent = next(path for path in folder.absolute().parents if path.exists())
    place = folder if folder.exists() else parent
    if not place.is_dir() or not os.access(place, os.W_OK):
        raise SettingError("--output", found=str(folder), expected="a folder that can be written")
    there = [name for name in _FILES if (folder / name).exists()]
    if there and not _is_report(folder / "report.json"):
        raise SettingError(
            "--output",
            found=f"{folder / there[0]}, which tangent-report did not write",
            expected="a new folder, or one with an earlier report",
            remedy="Give another folder.",
        )


def _is_report(path: Path) -> bool:
    from tangent_train.results.reports.tables import MADE_BY

    try:
        content = parse_json(path.read_text())
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("made_by") == MADE_BY
