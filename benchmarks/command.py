"""The command ``python -m benchmarks``: measure, compare with the baseline, or write it.

python -m benchmarks                        all that `make bench` measures
python -m benchmarks images labels          some of it
python -m benchmarks compare                measure, then compare with the baseline
python -m benchmarks compare results.json   compare what was measured
python -m benchmarks baseline results.json  make it the baseline, better of several runs
python -m benchmarks keypoints --help       these have settings of their own: keypoints, precision
"""

from __future__ import annotations

import argparse
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.compare import changes, changes_text, read_baseline, write_baseline
from benchmarks.measuring import Options
from benchmarks.report import machine, machine_line, read_results, table_text, write_results
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.measuring import Table

__all__ = ["MEASURED", "main"]

MEASURED = ("images", "labels", "loader", "step", "start", "evaluation", "growth")
"""What is measured without a name."""

OTHERS = ("keypoints", "precision")
"""What has settings of its own."""

_OUTPUT = Path("runs/bench")


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says.

    Args:
        arguments: It; by default the process's.
    """
    typed = list(sys.argv[1:] if arguments is None else arguments)
    name = typed[0] if typed else ""
    if name in OTHERS:
        import_module(f"benchmarks.{name}").main(typed[1:])
        return
    try:
        if {"-h", "--help"} & set(typed):
            _options(["--help"])
        elif name == "baseline":
            write_baseline([Path(path) for path in typed[1:]])
        elif name == "compare":
            _compare(typed[1:])
        else:
            _measure(_options(typed))
    except (DataError, SettingError) as error:
        sys.exit(f"benchmarks: {error}")


def _options(typed: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("names", nargs="*", metavar="name", help=f"of {', '.join(MEASURED)}; default all")
    add("--quick", action="store_true", help="small and few: the figures mean nothing")
    add("--rounds", type=int, help="measurements of each way")
    add("--output", type=Path, help=f"folder for the results; default {_OUTPUT}, or below it")
    add("--markdown", action="store_true", help="print the tables as Markdown, at the end")
    options = parser.parse_args(typed)
    unknown = [name for name in options.names if name not in MEASURED]
    if unknown:
        expected = ", ".join((*MEASURED, *OTHERS, "compare", "baseline"))
        raise SettingError("benchmarks", found=f"'{unknown[0]}'", expected=f"one of {expected}")
    if options.rounds is not None and options.rounds < 1:
        raise SettingError("--rounds", found=options.rounds, expected="1 or more")
    options.output = options.output or _OUTPUT / "_".join(options.names)
    return options


def _measure(options: argparse.Namespace) -> Path:
    """Measure, print and write the tables; returns the file of the results."""
    start, on = time.perf_counter(), machine()
    print(machine_line(on))
    tables: list[Table] = []
    for name in options.names or MEASURED:
        module = import_module(f"benchmarks.{name}")
        for table in module.tables(Options(options.quick, options.rounds)):
            print(f"\n{table_text(table)}", flush=True)
            tables.append(table)
        print(f"\n({name}: {time.perf_counter() - start:.0f} s so far)", flush=True)
    write_results(options.output, tables, options.quick, on)
    if options.markdown:
        print((options.output / "results.md").read_text(encoding="utf-8"))
    missed = [goal for table in tables for goal in table.goals if not goal.met]
    total = sum(len(table.goals) for table in tables)
    print(f"\n{total - len(missed)} of {total} goals met, in {time.perf_counter() - start:.0f} s.")
    print(f"Results and pictures are in {options.output}.")
    return Path(options.output / "results.json")


def _compare(typed: Sequence[str]) -> None:
    """Exit with 1 when something has become slower."""
    baseline, made_with = read_baseline()
    file = typed[0] if typed and not typed[0].startswith("-") else None
    path = _measure(_options(typed)) if file is None else Path(file)
    tables, content = read_results(path)
    if content["quick"]:
        raise DataError(path, found="a run with --quick", expected="one of full size")
    found = changes(tables, baseline)
    print(changes_text(found))
    cores = content["machine"]["cores"]
    if cores not in made_with["cores"]:
        print(f"The baseline is of {made_with['cores']} cores, this of {cores}: expect changes.")
    slower = [change for change in found if change.verdict == "slower"]
    if slower:
        sys.exit(f"{len(slower)} of {len(found)} have become slower.")
    print("Nothing has become slower beyond noise.")
