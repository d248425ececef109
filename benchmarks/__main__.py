"""Measure speed and memory, compare with the baseline, or write a new baseline.

python -m benchmarks                        all benchmarks (make bench)
python -m benchmarks images labels          some of them
python -m benchmarks methods                methods by level, see docs/results/prior_methods.md
python -m benchmarks compare                measure, then compare with the baseline
python -m benchmarks compare results.json   compare an earlier run with the baseline
python -m benchmarks baseline results.json  write the baseline, preferably from several runs
python -m benchmarks gpu                    all benchmarks of a GPU, see docs/results/speed.md
python -m benchmarks gpu render step        some of them
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

from torch.utils.collect_env import get_pretty_env_info

from benchmarks.measuring import DEVICE, FAILURES, Table, attempted
from tangent_train.results.tables import Table as TextTable

MEASURED = {
    name: f"benchmarks.{name}"
    for name in ("start", "images", "labels", "scores", "area", "depth", "methods")
}
MEASURED |= dict.fromkeys(("loader", "step", "evaluation"), "benchmarks.training")
"""Module of each benchmark; it has a function of the same name."""

LONG = ("methods",)
"""Benchmarks that run only by name."""

ON_A_GPU = {name: f"benchmarks.gpu.{name}" for name in ("render", "step", "predict", "fed")}
"""Module of each benchmark of ``gpu``."""

BASELINE = Path(__file__).with_name("baseline.json")
_NOISE = 1.1
"""Factor by which the load of a machine may change a quotient."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line.

    Args:
        arguments: Arguments of the command line, by default those of the process.
    """
    parser = argparse.ArgumentParser(
        "python -m benchmarks", None, __doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("names", nargs="*", help=f"compare, baseline, or {', '.join(MEASURED)}")
    parser.add_argument("--quick", action="store_true", help="toy sizes, to test the code")
    parser.add_argument("--output", type=Path, default=Path("runs/bench"), help="folder")
    options = parser.parse_args(arguments)
    command, names = "", options.names
    if names[:1] in (["compare"], ["baseline"], ["gpu"]):
        command, *names = names
    files = [Path(name) for name in names if name.endswith(".json")]
    if not files:
        measured = ON_A_GPU if command == "gpu" else MEASURED
        if unknown := sorted({*names} - {*measured}):
            parser.error(f"unknown: {', '.join(unknown)}")
        quick = options.quick or (command == "gpu" and DEVICE.type == "cpu")
        chosen = names or [name for name in measured if name not in LONG]
        files = [run({n: measured[n] for n in chosen}, options.output, quick=quick)]
    if command == "baseline":
        write_baseline([read(file) for file in files])
    elif command == "compare":
        compare(read(files[0]))


def run(modules: Mapping[str, str], output: Path, *, quick: bool) -> Path:
    """Measure, print and write ``results.json``.

    The file is written after each table, so an interrupted run keeps its results. Benchmarks that
    fail are listed at the end; the others continue.

    Args:
        modules: Modules of the benchmarks, by name.
        output: Folder of the file.
        quick: True for toy sizes.

    Returns:
        Path of the file.
    """
    start = time.perf_counter()
    tables: list[Table] = []
    content: dict[str, Any] = {"quick": quick, "failures": FAILURES}
    content["cores"] = len(os.sched_getaffinity(0))
    content["environment"] = get_pretty_env_info().splitlines()  # type: ignore[no-untyped-call]
    output.mkdir(parents=True, exist_ok=True)
    path = output / "results.json"

    def write() -> None:
        content["tables"] = [asdict(table) for table in tables]
        content["quotients"] = quotients(tables)
        path.write_text(json.dumps(content, indent=1, ensure_ascii=False), "utf-8")

    for name, module in modules.items():
        with attempted(name):
            for table in getattr(import_module(module), name)(quick):
                show(table)
                print(f"[{time.perf_counter() - start:.0f} s]", flush=True)
                tables.append(table)
                write()
    write()
    print(f"Results are in {path}.")
    if FAILURES:
        sys.exit("\n".join(("Failed:", *FAILURES)))
    return path


def show(table: Table) -> None:
    """Print a table and its goals."""
    rows = []
    for row in table.rows:
        ratios = table.ratios(row.name)
        spread = f"{min(ratios):.3g} to {max(ratios):.3g}"
        quotient = f"{table.ratio(row.name):.3g}×"
        rows.append((row.name, f"{row.median:.4g} {table.unit}", quotient, spread))
    TextTable(table.name, ("", "median", "of the first row", "rounds"), rows).print()
    for goal in table.goals:
        bound = f"at {'least' if goal.least else 'most'} {goal.bound:.3g}"
        print(f"{'met' if goal.met else 'MISSED'}: {goal.what} {goal.found:.3g} ({bound})")


def quotients(tables: Sequence[Table]) -> dict[str, dict[str, float]]:
    """Return this project's rows divided by the first row of their table: median and range."""
    found = {}
    for table in tables:
        for row in table.rows[1:]:
            if row.is_ours:
                values, name = table.ratios(row.name), f"{table.name}: {row.name}"
                median = statistics.median(values)
                found[name] = {"median": median, "low": min(values), "high": max(values)}
    return found


def read(path: Path) -> dict[str, Any]:
    """Read a ``results.json``; exit if it was written with ``--quick``."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if content["quick"]:
        sys.exit(f"{path}: found a run with --quick; expected a run of full size")
    return content


def compare(content: Mapping[str, Any]) -> None:
    """Print the changes of quotients; exit with 1 if one is slower beyond noise.

    A quotient is slower if all its rounds are above all rounds of the baseline, and its median is
    more than a tenth above the baseline's.
    """
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    if content["cores"] not in baseline["cores"]:
        print(f"Cores of the baseline: {baseline['cores']}; of this run: {content['cores']}.")
    slower = 0
    for name, now in content["quotients"].items():
        then, verdict = baseline["quotients"].get(name), "same"
        if then is None:
            verdict = "new"
        elif now["low"] > then["high"] and now["median"] > _NOISE * then["median"]:
            verdict, slower = "slower", slower + 1
        print(f"{verdict:7} {name}")
    if slower:
        sys.exit(f"{slower} of {len(content['quotients'])} have become slower.")
    print("Nothing has become slower beyond noise.")


def write_baseline(runs: Sequence[Mapping[str, Any]]) -> None:
    """Write the median of several runs' medians, and their widest interval, as the baseline."""
    picked: dict[str, Any] = {"median": statistics.median_low, "low": min, "high": max}
    rows = {}
    for name in dict.fromkeys(name for one in runs for name in one["quotients"]):
        found = [one["quotients"][name] for one in runs if name in one["quotients"]]
        row = {key: pick([one[key] for one in found]) for key, pick in picked.items()}
        rows[name] = {key: float(f"{value:.4g}") for key, value in row.items()}
    cores = sorted({one["cores"] for one in runs})
    text = json.dumps({"cores": cores, "runs": len(runs), "quotients": rows}, indent=1)
    BASELINE.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
