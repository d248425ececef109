"""The report over runs in the paper's layout: Markdown, CSV, JSON, tables for the terminal."""

from __future__ import annotations

import csv
import io
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from tangent_train.tasks.reports.cells import (
    Cells,
    cell,
    line,
    markdown_table,
    terminal_table,
    text,
)
from tangent_train.tasks.reports.groups import Figure, Group
from tangent_train.tasks.reports.losses import largest_losses
from tangent_train.tasks.reports.paper import CLASSES, STANFORD_ROWS, PaperRow
from tangent_train.tasks.reports.runs import MEANS, PER_CLASS

__all__ = [
    "MADE_BY",
    "MADE_ROOMS",
    "notes",
    "report_csv",
    "report_json",
    "report_markdown",
    "report_tables",
]

MADE_BY = "tangent-report"
"""Stands in the JSON file: the mark of a report."""

_LEGEND = (
    "Percent. Mean over folds of the mean over seeds; ± the sample standard deviation over folds, "
    "in brackets that over seeds within a fold. The paper's own rows are means over the 3 folds."
)
MADE_ROOMS = "Made rooms: nothing here is comparable with figures on real data."
"""Stands beside figures of `SynthRooms`."""

_OVERALL = (
    "s", "method", "input", "b", "mAcc", "mIoU", "mAcc by solid angle", "mIoU by solid angle",
    "folds", "runs",
)  # fmt: skip


@dataclass(frozen=True)
class _Section:
    """Groups on the same data, as tables of cells; the first row is the header."""

    title: str
    remark: str
    overall: list[Cells]
    per_class: dict[str, list[Cells]]
    losses: list[str]


def notes(groups: Sequence[Group]) -> list[str]:
    """What has to be known beside the figures: folds that lack, runs that are there twice."""
    found = []
    for group in groups:
        if group.missing_folds:
            lacking = " and ".join(map(str, group.missing_folds))
            found.append(f"{group.label}: fold {lacking} missing; not a mean of 3 folds.")
        found += [
            f"{group.label}: fold {run.fold}, seed {run.settings.get('seed')} more than once, also "
            f"in {run.folder}."
            for run in group.repeated
        ]
        absent = [
            f"{name} ({figure.folds} of {_folds(group)})"
            for name, figure in zip(group.class_names, _figures(group, "iou"), strict=True)
            if figure.folds < _folds(group)
        ]
        if absent:
            rule = "; the paper's code counts them as 0" if group.paper else ""
            found.append(
                f"{group.label}: classes not in every fold: {', '.join(absent)}. Where absent, "
                f"they are left out of the means{rule}."
            )
    return found


def report_markdown(groups: Sequence[Group], remarks: Sequence[str]) -> str:
    """The report as Markdown.

    Args:
        groups: From `groups.group_runs`.
        remarks: Sentences to stand below the tables.
    """
    lines = ["# Report", "", _LEGEND, ""]
    for section in _sections(groups):
        lines += [f"## {section.title}", ""]
        lines += [section.remark, ""] if section.remark else []
        lines += [*markdown_table(section.overall, left=3), ""]
        for title, cells in section.per_class.items():
            lines += [f"### {title}", "", *markdown_table(cells, left=1), ""]
        lines += [*(f"- {sentence}" for sentence in section.losses), ""] if section.losses else []
    lines += [f"- {remark}" for remark in remarks]
    lines += ["", "| group | fold | seed | run |", "| --- | ---: | ---: | --- |"]
    lines += [
        line((group.label, text(run.fold), text(run.settings.get("seed")), str(run.folder)))
        for group in groups
        for run in group.runs
    ]
    return "\n".join(lines) + "\n"


def report_tables(groups: Sequence[Group]) -> list[Table]:
    """The overall tables for the terminal.

    Args:
        groups: From `groups.group_runs`.
    """
    return [
        terminal_table(
            section.title,
            section.overall,
            (1, 2),
            "\n".join(filter(None, (section.remark, *section.losses))),
        )
        for section in _sections(groups)
    ]


def report_csv(groups: Sequence[Group]) -> str:
    """One line per group, class ("mean" for all) and figure; shares of 1.

    Args:
        groups: From `groups.group_runs`.
    """
    file = io.StringIO()
    columns = ["group", "data", "level", "base_level", "inputs", "runs", "class", "figure"]
    columns += ["mean", "over_folds", "over_seeds", "folds", "paper"]
    writer = csv.DictWriter(file, columns, lineterminator="\n")
    writer.writeheader()
    for group in groups:
        for class_name, name, figure, paper in _all_figures(group):
            row = {"group": group.label, "runs": len(group.runs), "class": class_name}
            writer.writerow(row | _facts(group) | {"figure": name, "paper": paper} | asdict(figure))
    return file.getvalue()


def report_json(groups: Sequence[Group], remarks: Sequence[str]) -> str:
    """Everything in the report, figures as shares of 1.

    Args:
        groups: From `groups.group_runs`.
        remarks: As in the Markdown file.
    """
    content = []
    for group in groups:
        figures: dict[str, dict[str, Any]] = defaultdict(dict)
        for class_name, name, figure, paper in _all_figures(group):
            figures[class_name][name] = asdict(figure) | {"paper": paper}
        content.append(
            {
                "label": group.label,
                **_facts(group),
                "folds": list(group.folds),
                "missing_folds": list(group.missing_folds),
                "runs": [
                    {
                        "folder": str(run.folder),
                        "fold": run.fold,
                        "seed": run.settings.get("seed"),
                        "images": run.images,
                    }
                    for run in group.runs
                ],
                "means": figures.pop("mean"),
                "classes": dict(figures),
            }
        )
    report = {"made_by": MADE_BY, "unit": "shares of 1", "groups": content, "notes": [*remarks]}
    return json.dumps(report, indent=1) + "\n"


def _facts(group: Group) -> dict[str, Any]:
    return {
        "data": group.data,
        "level": group.setting("level"),
        "base_level": group.base_level,
        "inputs": group.inputs,
    }


def _all_figures(group: Group) -> Iterator[tuple[str, str, Figure, float | None]]:
    """Class ("mean" for all), name, figure, and the paper's as a share of 1."""
    paper = group.paper
    for name in MEANS:
        printed = getattr(paper, name, None)
        yield "mean", name, group.figure(name), _share(printed)
    for k, class_name in enumerate(group.class_names):
        for name in PER_CLASS:
            of_classes = getattr(paper, name, None)
            printed = of_classes[k] if of_classes else None
            yield class_name, name, group.figure(name, k), _share(printed)


def _sections(groups: Sequence[Group]) -> list[_Section]:
    of_data: dict[str, list[Group]] = defaultdict(list)
    for group in groups:
        of_data[group.data].append(group)
    sections = []
    for title, members in of_data.items():
        made = ".SynthRooms" in str(members[0].setting("data._target_"))
        printed = _printed_rows(members)
        rows: list[PaperRow | Group] = [*printed, *members]
        ranked = sorted(rows, key=_level)
        per_class = {
            "Accuracy %": _per_class(ranked, members[0].class_names, "accuracy"),
            "IoU %": _per_class(ranked, members[0].class_names, "iou"),
        }
        overall = [_OVERALL, *map(_overall, ranked)]
        remark, losses = MADE_ROOMS if made else "", largest_losses(members)
        sections.append(_Section(title, remark, overall, per_class, losses))
    return sections


def _printed_rows(members: Sequence[Group]) -> list[PaperRow]:
    """The paper's rows, its own and its rivals', at the levels of groups that it has a row for."""
    levels = {group.paper.level for group in members if group.paper is not None}
    return [row for row in STANFORD_ROWS if row.level in levels]


def _level(row: PaperRow | Group) -> int:
    level = row.level if isinstance(row, PaperRow) else row.setting("level")
    return int(level or 0)


def _overall(row: PaperRow | Group) -> Cells:
    if isinstance(row, PaperRow):
        figures = tuple(text(figure) for figure in (row.macc, row.miou))
        start = (str(row.level), _method(row), row.inputs, str(row.base_level))
        return (*start, *figures, "", "", "3" if row.method == "Ours" else "", "")
    names = ("macc", "miou", "macc_solid_angle", "miou_solid_angle")
    folds = ", ".join(map(str, row.folds)) or "–"
    if row.missing_folds:
        folds += " only"
    start = (text(row.setting("level")), row.label, row.inputs, str(row.base_level))
    return (*start, *(cell(row.figure(n), _folds(row)) for n in names), folds, str(len(row.runs)))


def _per_class(
    rows: Sequence[PaperRow | Group], class_names: Sequence[str], name: str
) -> list[Cells]:
    cells: list[Cells] = [("method", *class_names)]
    for row in rows:
        if isinstance(row, Group):
            cells.append((row.label, *(cell(f, _folds(row)) for f in _figures(row, name))))
        elif getattr(row, name) and tuple(class_names) == CLASSES:
            method = f"{_method(row)}, level {row.level}"
            cells.append((method, *(f"{figure:.1f}" for figure in getattr(row, name))))
    return cells


def _figures(group: Group, name: str) -> list[Figure]:
    return [group.figure(name, k) for k in range(len(group.class_names))]


def _folds(group: Group) -> int:
    return len(group.folds) or 1


def _method(row: PaperRow) -> str:
    return "tangent images (paper)" if row.method == "Ours" else f"{row.method} (paper)"


def _share(percent: float | None) -> float | None:
    return None if percent is None else percent / 100
