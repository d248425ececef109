"""Whether something has become slower than in the baseline, beyond noise.

The baseline holds quotients only: how this project's rows compare with the first row of their
table, and between what several runs found them. A row is a regression when all of its interval is
above all of the baseline's and its median is more than a tenth above.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from benchmarks.measuring import Interval
from benchmarks.report import in_columns, read_results
from tangent_train.errors import DataError
from tangent_train.files import write_text

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from benchmarks.measuring import Table

__all__ = ["BASELINE", "Change", "changes", "changes_text", "read_baseline", "write_baseline"]

BASELINE = Path(__file__).with_name("baseline.json")

_NOISE = 1.1
"""What the memory layout of one process or the load of a machine may make of a quotient."""

Verdict = Literal["slower", "faster", "same", "not measured", "new"]


class Change(NamedTuple):
    """A row then and now.

    Attributes:
        name: Of table and row.
        then: In the baseline.
        now: In the results.
        verdict: What became of it; memory that grew is ``slower`` too.
    """

    name: str
    then: Interval | None
    now: Interval | None
    verdict: Verdict


def quotients(tables: Sequence[Table]) -> dict[str, Interval]:
    """This project's rows beside the first of their table."""
    return {
        f"{table.name}: {row.name}": table.ratio(row.name)
        for table in tables
        for row in table.rows[1:]
        if row.ours
    }


def changes(tables: Sequence[Table], baseline: Mapping[str, Interval]) -> list[Change]:
    """Every row of the baseline or the results."""
    now = quotients(tables)
    names = dict.fromkeys([*baseline, *now])
    return [_change(name, baseline.get(name), now.get(name)) for name in names]


def _change(name: str, then: Interval | None, now: Interval | None) -> Change:
    verdict: Verdict = "same"
    if then is None or now is None:
        verdict = "new" if then is None else "not measured"
    elif now.low > then.high and now.median > _NOISE * then.median:
        verdict = "slower"
    elif now.high < then.low and now.median * _NOISE < then.median:
        verdict = "faster"
    return Change(name, then, now, verdict)


def changes_text(found: Sequence[Change]) -> str:
    """A line for every row; those that became slower last."""
    order = ("not measured", "new", "same", "faster", "slower")
    lines = [
        [change.name, _text(change.then), _text(change.now), change.verdict]
        for change in sorted(found, key=lambda change: order.index(change.verdict))
    ]
    return in_columns([["× the first of its table", "then", "now", ""], *lines])


def _text(interval: Interval | None) -> str:
    if interval is None:
        return "–"
    return f"{interval.median:.3g} ({interval.low:.3g} to {interval.high:.3g})"


def write_baseline(results: Sequence[Path], path: Path = BASELINE) -> None:
    """Write what several runs found: the median of medians, and the widest interval.

    Args:
        results: Files ``results.json`` of runs of one machine.
        path: Where to.

    Raises:
        DataError: A file cannot be used, or its figures mean nothing.
    """
    runs, cores = [], set()
    for file in results:
        tables, content = read_results(file)
        if content["quick"]:
            raise DataError(file, found="a run with --quick", expected="one of full size")
        runs.append(quotients(tables))
        cores.add(content["machine"]["cores"])
    rows = {}
    for name in dict.fromkeys(name for run in runs for name in run):
        found = [run[name] for run in runs if name in run]
        medians = sorted(interval.median for interval in found)
        rows[name] = {
            "median": float(f"{medians[len(medians) // 2]:.4g}"),
            "low": float(f"{min(interval.low for interval in found):.4g}"),
            "high": float(f"{max(interval.high for interval in found):.4g}"),
        }
    content = {"cores": sorted(cores), "runs": len(runs), "quotients": rows}
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def read_baseline(path: Path = BASELINE) -> tuple[dict[str, Interval], dict[str, Any]]:
    """The quotients, and all else that is in it.

    Raises:
        DataError: There is none.
    """
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return {n: Interval(**row) for n, row in content.pop("quotients").items()}, content
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            path, found=f"{type(error).__name__}: {error}", expected="a baseline",
            remedy="Write one: python -m benchmarks baseline runs/bench/results.json",
        ) from error  # fmt: skip
