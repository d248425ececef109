"""Measure, compare with the baseline, or write it.

python -m benchmarks                        all that `make bench` measures
python -m benchmarks images labels          some of it
python -m benchmarks compare                measure, then compare with the baseline
python -m benchmarks compare results.json   compare what was measured
python -m benchmarks baseline results.json  make it the baseline, better of several runs
python -m benchmarks gpu                    all that is measured on a GPU, see docs/results/gpu.md
python -m benchmarks gpu render step        some of it
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

MEASURED = {name: f"benchmarks.{name}" for name in ("images", "labels")}
MEASURED |= dict.fromkeys(("loader", "step", "evaluation"), "benchmarks.training")
"""Modules of the rows; each has a function of the same name."""

ON_A_GPU = {name: f"benchmarks.gpu.{name}" for name in ("render", "step", "predict", "fed")}
"""Likewise, of ``gpu``."""

BASELINE = Path(__file__).with_name("baseline.json")
_NOISE = 1.1
"""The load of a machine may change a quotient that much."""


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
    command, names = "", options.names
    if names[:1] in (["compare"], ["baseline"], ["gpu"]):
        command, *names = names
    files = [Path(name) for name in names if name.endswith(".json")]
    if not files:
        measured = ON_A_GPU if command == "gpu" else MEASURED
        if unknown := sorted({*names} - {*measured}):
            parser.error(f"unknown: {', '.join(unknown)}")
        quick = options.quick or (command == "gpu" and DEVICE.type == "cpu")
        files = [run({n: measured[n] for n in names or measured}, options.output, quick=quick)]
    if command == "baseline":
        write_baseline([read(file) for file in files])
    elif command == "compare":
        compare(read(files[0]))


def run(modules: Mapping[str, str], output: Path, *, quick: bool) -> Path:
    """Measure, print and write ``results.json``, whose path is returned.

    Written after every table: what is stopped keeps what it has. What fails is listed, and the
    others go on.

    Args:
        modules: Of the rows, by name.
        output: Folder.
        quick: Toy size.
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
    """Print a table with its goals."""
    rows = []
    for row in table.rows:
        ratios = table.ratios(row.name)
        spread = f"{min(ratios):.3g} to {max(ratios):.3g}"
        quotient = f"{table.ratio(row.name):.3g}×"
        rows.append((row.name, f"{row.median:.4g} {table.unit}", quotient, spread))
    TextTable(table.name, ("", "median", "of the first", "rounds"), rows).print()
    for goal in table.goals:
        bound = f"at {'least' if goal.least else 'most'} {goal.bound:.3g}"
        print(f"{'met' if goal.met else 'MISSED'}: {goal.what} {goal.found:.3g} ({bound})")


def quotients(tables: Sequence[Table]) -> dict[str, dict[str, float]]:
    """This project's rows over the first of their table: median, least and most."""
    found = {}
    for table in tables:
        for row in table.rows[1:]:
            if row.ours:
                values, name = table.ratios(row.name), f"{table.name}: {row.name}"
                median = statistics.median(values)
                found[name] = {"median": median, "low": min(values), "high": max(values)}
    return found


def read(path: Path) -> dict[str, Any]:
    """The content of a ``results.json`` of full size."""
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if content["quick"]:
        sys.exit(f"{path}: found a run with --quick; expected one of full size")
    return content


def compare(content: Mapping[str, Any]) -> None:
    """Print how quotients changed; exit with 1 if something is slower beyond noise.

    That is, all its rounds are above all of the baseline's, and its median is a tenth above.
    """
    baseline = json.loads(BASELINE.read_text(encoding="utf-8"))
    if content["cores"] not in baseline["cores"]:
        print(f"The baseline is of {baseline['cores']} cores, this of {content['cores']}.")
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
    """Write the median of several runs' medians, and the widest interval."""
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
