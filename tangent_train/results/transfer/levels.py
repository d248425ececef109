"""One network at several levels: what becomes of its figures away from the photos' resolution.

The paper's third transfer experiment: photos are normalised to the angular resolution of one level;
figures fall the further that of the panoramas is from it.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from rich.table import Table

from tangent_train.csv_text import csv_text
from tangent_train.errors import DataError
from tangent_train.results.reports.cells import (
    Cells,
    cell,
    change,
    line,
    markdown_table,
    terminal_table,
    text,
)
from tangent_train.results.reports.groups import Group, check_classes
from tangent_train.results.reports.runs import MEANS, Run
from tangent_train.results.reports.tables import MADE_ROOMS
from tangent_train.results.transfer.rows import Averages, check_once, sort_key
from tangent_train.results.transfer.tables import MADE_BY

__all__ = [
    "LevelReport",
    "LevelResult",
    "LevelRow",
    "gather_levels",
    "levels_csv",
    "levels_json",
    "levels_markdown",
    "levels_notes",
    "levels_tables",
]

_LEGEND = (
    "Percent. Mean over folds of the mean over seeds; ± the sample standard deviation over folds, "
    "in brackets that over seeds within a fold. Change: against the level nearest to the "
    "resolution that the photos had in training, over the folds and seeds that both have."
)


@dataclass(frozen=True)
class LevelResult:
    """An evaluation at a level.

    Attributes:
        level: s of the panoramas.
        fold: None for data without folds.
        seed: Of the network's training.
        run: Its figures.
    """

    level: int
    fold: int | None
    seed: int
    run: Run


@dataclass(frozen=True)
class LevelRow(Averages[LevelResult]):
    """A level over folds and seeds; its partner is the level nearest to that of training."""

    @property
    def level(self) -> int:
        """The panoramas' level s."""
        return self.results[0].level


@dataclass(frozen=True)
class LevelReport:
    """All levels.

    Attributes:
        rows: Coarse to fine.
        trained_level: The level whose angular resolution the photos were normalised to; between
            two levels where it is that of neither.
    """

    rows: tuple[LevelRow, ...]
    trained_level: float

    @property
    def nearest(self) -> LevelRow:
        """The level nearest to that of training; the coarser of two."""
        return min(self.rows, key=lambda row: abs(row.level - self.trained_level))

    @property
    def folds(self) -> tuple[int | None, ...]:
        """The folds of all levels."""
        found = {fold for row in self.rows for fold in row.folds}
        return tuple(sorted(found, key=lambda fold: fold or 0))

    @property
    def group(self) -> Group:
        """The runs at the first level, for their data and inputs."""
        return Group("", tuple(result.run for result in self.rows[0].results))


def gather_levels(results: Sequence[LevelResult], trained_level: float) -> LevelReport:
    """Put evaluations at several levels together.

    Args:
        results: In any order.
        trained_level: The level whose angular resolution the photos were normalised to.

    Raises:
        DataError: There are none, their classes differ, or a fold and seed of a level is there
            twice.
    """
    if not results:
        raise DataError("levels", found="no evaluation", expected="those of one level or more")
    check_classes([result.run for result in results])
    members: dict[int, list[LevelResult]] = defaultdict(list)
    for result in results:
        members[result.level].append(result)
    for level, found in members.items():
        check_once(found, f"level {level}")
    report = LevelReport(
        tuple(LevelRow(tuple(sorted(members[level], key=sort_key))) for level in sorted(members)),
        float(trained_level),
    )
    nearest = report.nearest
    rows = (row if row is nearest else replace(row, partner=nearest) for row in report.rows)
    return replace(report, rows=tuple(rows))


def levels_notes(report: LevelReport) -> list[str]:
    """What has to be known beside the figures.

    Args:
        report: From `gather_levels`.
    """
    every = frozenset().union(*(row.members for row in report.rows))
    return [
        f"Level {row.level}: {len(row.members)} of {len(every)} folds and seeds; its figures are "
        "not over the same runs as the others'."
        for row in report.rows
        if row.members != every
    ]


def levels_markdown(report: LevelReport) -> str:
    """The report as Markdown.

    Args:
        report: From `gather_levels`.
    """
    lines = ["# One network at several levels", "", _LEGEND, "", _facts(report), ""]
    lines += [*markdown_table(_cells(report), left=1), ""]
    notes = [f"- {note}" for note in levels_notes(report)]
    lines += [*notes, ""] if notes else []
    lines += ["| level | fold | seed | run |", "| ---: | ---: | ---: | --- |"]
    lines += [
        line((str(row.level), text(result.fold), str(result.seed), str(result.run.folder)))
        for row in report.rows
        for result in row.results
    ]
    return "\n".join(lines) + "\n"


def levels_tables(report: LevelReport) -> list[Table]:
    """The table for the terminal.

    Args:
        report: From `gather_levels`.
    """
    title = "One network at several levels"
    return [terminal_table(title, _cells(report), (), _facts(report))]


def levels_csv(report: LevelReport) -> str:
    """One line per level, fold ("mean" over all) and figure; shares of 1.

    Args:
        report: From `gather_levels`.
    """
    columns = ["level", "fold", "figure", "mean", "over_folds", "over_seeds", "folds", "kept"]
    rows: list[dict[str, Any]] = []
    for row in report.rows:
        for fold, part in _scopes(row):
            for name in MEANS:
                figures = {"figure": name} | asdict(part.figure(name))
                of_trained = {"kept": part.kept(name).mean}
                rows.append({"level": row.level, "fold": fold} | figures | of_trained)
    return csv_text(columns, rows)


def levels_json(report: LevelReport) -> str:
    """Everything in the report, figures as shares of 1.

    Args:
        report: From `gather_levels`.
    """
    content = {
        "made_by": MADE_BY,
        "study": "levels",
        "unit": "shares of 1",
        "data": {"name": report.group.data, "inputs": report.group.inputs},
        "trained_level": report.trained_level,
        "compared_with": report.nearest.level,
        "levels": [
            {
                "level": row.level,
                "scopes": [{"fold": fold, "means": _means(part)} for fold, part in _scopes(row)],
                "runs": [
                    {"fold": result.fold, "seed": result.seed, "folder": str(result.run.folder)}
                    for result in row.results
                ],
            }
            for row in report.rows
        ],
        "notes": levels_notes(report),
    }
    return json.dumps(content, indent=1) + "\n"


def _means(row: LevelRow) -> dict[str, Any]:
    return {name: asdict(row.figure(name)) | {"kept": asdict(row.kept(name))} for name in MEANS}


def _scopes(row: LevelRow) -> list[tuple[int | str | None, LevelRow]]:
    """The folds, each with its part, and "mean" over all of them."""
    parts = [(fold, row.of_fold(fold)) for fold in row.folds]
    return [*((fold, part) for fold, part in parts if part is not None), ("mean", row)]


def _facts(report: LevelReport) -> str:
    group = report.group
    made = f" {MADE_ROOMS}" if group.data.startswith("SynthRooms") else ""
    return (
        f"Panoramas: {group.data}, {group.inputs}. Photos in training: the angular resolution of "
        f"level {report.trained_level:g}.{made}"
    )


def _cells(report: LevelReport) -> list[Cells]:
    nearest = f"change from level {report.nearest.level}"
    header = ("level", "mAcc %", nearest, "mIoU %", nearest, "mIoU % by solid angle", "runs")
    rows: list[Cells] = [header]
    for row in report.rows:
        figures: Cells = ()
        for name in ("macc", "miou"):
            figure = cell(row.figure(name), len(report.folds))
            figures += (figure, change(row.kept(name).mean))
        solid = cell(row.figure("miou_solid_angle"), len(report.folds))
        rows.append((str(row.level), *figures, solid, str(len(row.results))))
    return rows
