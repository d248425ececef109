"""Measure, compare with the baseline, or write it.

python -m benchmarks                        all that `make bench` measures
python -m benchmarks images labels          some of it
python -m benchmarks compare                measure, then compare with the baseline
python -m benchmarks compare results.json   compare what was measured
python -m benchmarks baseline results.json  make it the baseline, better of several runs
python -m benchmarks gpu                    all that is measured on a GPU, see docs/gpu.md
python -m benchmarks gpu correct step       some of it
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.measuring import Goal, Row, Table

MEASURED = {
    "images": "benchmarks.images",
    "labels": "benchmarks.labels",
    "growth": "benchmarks.labels",
    "loader": "benchmarks.training",
    "step": "benchmarks.training",
    "evaluation": "benchmarks.training",
    "start": "benchmarks.start",
}
"""Modules of the rows; each has a function of the same name."""

ON_A_GPU = {name: f"benchmarks.gpu.{name}" for name in ("correct", "step", "predict", "fed")}
"""Likewise, of ``gpu``."""

BASELINE = Path(__file__).with_name("baseline.json")
_NOISE = 1.1
"""The load of a machine may change a quotient that much."""


class Interval(NamedTuple):
    """Median, least and most of a quotient."""

    median: float
    low: float
    high: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says.

    Args:
        arguments: By default the process's.
    """
    parser = argparse.ArgumentParser(
        "python -m benchmarks", None, __doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", help=f"compare, baseline, or {', '.join(MEASURED)}")
    parser.add_argument("--quick", action="store_true", help="small: the figures mean nothing")
    parser.add_argument("--output", type=Path, default=Path("runs/bench"), help="folder")
    options = parser.parse_args(arguments)
    command, files = "", [Path(name) for name in options.names if name.endswith(".json")]
    if options.names[:1] in (["compare"], ["baseline"], ["gpu"]):
        command, *options.names = options.names
    if command == "baseline":
        write_baseline(files)
        return
    if not files:
        measured = ON_A_GPU if command == "gpu" else MEASURED
        unknown = sorted({*options.names} - {*measured})
        if unknown:
            parser.error(f"unknown: {', '.join(unknown)}")
        modules = {name: measured[name] for name in options.names or measured}
        files = [run(modules, options.output, quick=options.quick)]
    if command == "compare":
        compare(files[0])


def run(modules: Mapping[str, str], output: Path, *, quick: bool) -> Path:
    """Measure, print and write ``results.json``, whose path is returned, and ``results.md``.

    Written after every table: what is stopped keeps what it has.

    Args:
        modules: Of the rows, by name.
        output: Folder.
        quick: Toy size.
    """
    start = time.perf_counter()
    tables: list[Table] = []
    libraries = ("torch", "numpy", "opencv-python-headless", "numba", "lightning")
    content: dict[str, Any] = {
        "quick": quick,
        "cores": len(os.sched_getaffinity(0)),
        "machine": f"{platform.processor()} {platform.platform(terse=True)}",
        "versions": {library: version(library) for library in libraries},
    }
    if {*modules} <= {*ON_A_GPU}:
        gpu = import_module("benchmarks.gpu.device")
        content |= {"quick": gpu.QUICK, "failures": gpu.FAILURES, **gpu.device_facts()}
    output.mkdir(parents=True, exist_ok=True)
    path = output / "results.json"
    for name, module in modules.items():
        for table in getattr(import_module(module), name)(content["quick"]):
            print(f"{table_text(table)}\n[{time.perf_counter() - start:.0f} s]", flush=True)
            tables.append(table)
            content["tables"] = [asdict(table) for table in tables]
            path.write_text(json.dumps(content, indent=1, ensure_ascii=False), encoding="utf-8")
            path.with_suffix(".md").write_text(markdown(content, tables), encoding="utf-8")
    goals = [goal for table in tables for goal in table.goals]
    met = sum(goal.met for goal in goals)
    print(f"{met} of {len(goals)} goals met, in {time.perf_counter() - start:.0f} s")
    print(f"Results are in {path}.")
    return path


def markdown(content: Mapping[str, Any], tables: Sequence[Table]) -> str:
    """The tables, after what is known of the machine."""
    facts = [f"- {name}: {value}" for name, value in content.items() if name != "tables"]
    return "\n".join([*facts, *(f"```text{table_text(table)}\n```" for table in tables), ""])


def table_text(table: Table) -> str:
    """A table for the terminal, with its goals."""
    width = max(len(row.name) for row in table.rows)
    lines = [f"\n{table.name}"]
    for row in table.rows:
        low, high = min(table.ratios(row.name)), max(table.ratios(row.name))
        quotient = f"{table.ratio(row.name):8.3g}×  ({low:.3g} to {high:.3g})"
        lines.append(f"  {row.name:{width}} {row.median:10.4g} {table.unit} {quotient}")
    for goal in table.goals:
        bound = f"at {'least' if goal.least else 'most'} {goal.bound:.3g}"
        verdict = "met" if goal.met else "MISSED"
        lines.append(f"  {verdict}: {goal.what} {goal.found:.3g} ({bound})")
    return "\n".join(lines)


def read(path: Path) -> tuple[list[Table], dict[str, Any]]:
    """The tables of a ``results.json`` of full size, and all else that is in it."""
    content = json.loads(path.read_text(encoding="utf-8"))
    if content["quick"]:
        sys.exit(f"{path}: found a run with --quick; expected one of full size")
    tables = [
        Table(
            table["name"],
            [Row(**row) for row in table["rows"]],
            table["unit"],
            [Goal(*goal) for goal in table["goals"]],
        )
        for table in content.pop("tables")
    ]
    return tables, content


def quotients(tables: Sequence[Table]) -> dict[str, Interval]:
    """This project's rows over the first of their table."""
    found = {}
    for table in tables:
        for row in table.rows[1:]:
            if row.ours:
                values = table.ratios(row.name)
                interval = Interval(statistics.median(values), min(values), max(values))
                found[f"{table.name}: {row.name}"] = interval
    return found


def compare(path: Path) -> None:
    """Print how quotients changed; exit with 1 if something is slower beyond noise.

    That is, all its rounds are above all of the baseline's, and its median is a tenth above.
    """
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    then = {name: Interval(**interval) for name, interval in baseline["quotients"].items()}
    tables, content = read(path)
    if content["cores"] not in baseline["cores"]:
        print(f"The baseline is of {baseline['cores']} cores, this of {content['cores']}.")
    found = verdicts(quotients(tables), then)
    for name, verdict in found.items():
        print(f"{verdict:7} {name}")
    slower = sum(verdict == "slower" for verdict in found.values())
    if slower:
        sys.exit(f"{slower} of {len(found)} have become slower.")
    print("Nothing has become slower beyond noise.")


def verdicts(now: Mapping[str, Interval], then: Mapping[str, Interval]) -> dict[str, str]:
    """``slower``, ``faster``, ``same`` or ``new`` by name; larger memory is slower too."""
    found = {}
    for name, one in now.items():
        other = then.get(name)
        if other is None:
            found[name] = "new"
        elif one.low > other.high and one.median > _NOISE * other.median:
            found[name] = "slower"
        elif one.high < other.low and one.median * _NOISE < other.median:
            found[name] = "faster"
        else:
            found[name] = "same"
    return found


def write_baseline(files: Sequence[Path]) -> None:
    """Write the median of several runs' medians, and the widest interval."""
    runs = [read(file) for file in files]
    found = [quotients(tables) for tables, _ in runs]
    rows = {}
    for name in dict.fromkeys(name for one in found for name in one):
        intervals = [one[name] for one in found if name in one]
        median = statistics.median_low(interval.median for interval in intervals)
        low, high = min(i.low for i in intervals), max(i.high for i in intervals)
        rows[name] = {"median": median, "low": low, "high": high}
    rounded = {n: {k: float(f"{v:.4g}") for k, v in row.items()} for n, row in rows.items()}
    cores = sorted({content["cores"] for _, content in runs})
    text = json.dumps({"cores": cores, "runs": len(runs), "quotients": rounded}, indent=1)
    BASELINE.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
