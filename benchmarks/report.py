"""What was measured, as text, Markdown, JSON and pictures."""

from __future__ import annotations

import json
import os
import platform
import re
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from benchmarks.measuring import Goal, Row, Table
from tangent_train.errors import DataError
from tangent_train.files import write_bytes, write_text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = [
    "amount",
    "in_columns",
    "machine",
    "read_results",
    "table_markdown",
    "table_text",
    "write_results",
]

_PACKAGES = (
    "torch",
    "numpy",
    "opencv-python-headless",
    "numba",
    "lightning",
    "py360convert",
    "pyequilib",
    "pytorch360convert",
)
_HEADER = ["", "median", "× the first", "95 %"]


def machine() -> dict[str, Any]:
    """What it was measured on."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "threads": torch.get_num_threads(),
        "gpu": gpu,
        "system": platform.platform(terse=True),
        "versions": {"python": platform.python_version(), **_versions()},
    }


def _processor() -> str:
    file = Path("/proc/cpuinfo")
    text = file.read_text() if file.exists() else ""
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found[1] if found else platform.processor() or platform.machine()


def _versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return versions


def machine_line(content: Mapping[str, Any]) -> str:
    """The machine in a line."""
    versions = ", ".join(f"{name} {number}" for name, number in content["versions"].items())
    gpu = f", {content['gpu']}" if content["gpu"] else ""
    return (
        f"{content['processor']}, {content['cores']} cores, {content['threads']} threads{gpu}; "
        f"{content['system']}; {versions}"
    )


def amount(value: float, unit: str) -> str:
    """A value with three digits and a unit that fits."""
    if unit == "s":
        for factor, name in ((1, "s"), (1e3, "ms"), (1e6, "µs")):
            if value * factor >= 1 or name == "µs":
                value, unit = value * factor, name
                break
    digits = 0 if value >= 99.95 else 1 if value >= 9.995 else 2
    return f"{value:,.{digits}f} {unit}"


def _cells(table: Table, row: Row) -> list[str]:
    ratio = table.ratio(row.name)
    spread = "" if row is table.rows[0] else f"{ratio.low:.3g} to {ratio.high:.3g}"
    return [row.name, amount(row.median, table.unit), f"{ratio.median:.3g}×", spread]


def goal_line(goal: Goal) -> str:
    """A promise, what was found, and whether it is kept."""
    bound = f"at {'least' if goal.least else 'most'} {goal.bound:.3g}{goal.unit}"
    return f"{'met' if goal.met else 'MISSED'}: {goal.what} {goal.found:.3g}{goal.unit} ({bound})"


def in_columns(lines: Sequence[Sequence[str]]) -> str:
    """Cells below each other, the first to the left, all others to the right."""
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    text = [
        "  ".join(
            cell.ljust(width) if not column else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ).rstrip()
        for cells in lines
    ]
    return "\n".join(f"  {line}" for line in text)


def table_text(table: Table) -> str:
    """A table for the terminal."""
    rows = [_HEADER, *(_cells(table, row) for row in table.rows)]
    below = [*map(goal_line, table.goals), *table.notes]
    return "\n".join([table.title, in_columns(rows), *(f"  {line}" for line in below)])


def table_markdown(table: Table) -> str:
    """A table for a document."""
    rows = [_HEADER, ["---", "---:", "---:", "---:"], *(_cells(table, row) for row in table.rows)]
    lines = [f"| {' | '.join(cells)} |" for cells in rows]
    below = [f"- {line}" for line in (*map(goal_line, table.goals), *table.notes)]
    return "\n".join([f"### {table.title}", "", *lines, *([""] if below else []), *below])


def write_results(
    folder: Path, tables: Sequence[Table], quick: bool, on: Mapping[str, Any]
) -> None:
    """Write ``results.json``, ``results.md`` and a picture of each benchmark.

    Args:
        folder: Where to.
        tables: In their order.
        quick: Whether the figures mean nothing.
        on: The machine.
    """
    from benchmarks.chart import tables_png

    content = {"quick": quick, "machine": on, "tables": [asdict(table) for table in tables]}
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "results.json", json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    text = "\n\n".join([machine_line(on), *map(table_markdown, tables)])
    write_text(folder / "results.md", text + "\n")
    for name in dict.fromkeys(table.name.partition(":")[0] for table in tables):
        group = [table for table in tables if table.name.partition(":")[0] == name]
        write_bytes(folder / f"{name}.png", tables_png(group))


def read_results(path: Path) -> tuple[list[Table], dict[str, Any]]:
    """The tables of a ``results.json``, and all else that is in it.

    Raises:
        DataError: There is none, or it is not one.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        tables = [
            Table(
                **{
                    **table,
                    "rows": [Row(**row) for row in table["rows"]],
                    "goals": [Goal(*goal) for goal in table["goals"]],
                }
            )
            for table in content.pop("tables")
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            path, found=f"{type(error).__name__}: {error}", expected="results of the benchmarks",
            remedy="Measure them with make bench.",
        ) from error  # fmt: skip
    return tables, content
