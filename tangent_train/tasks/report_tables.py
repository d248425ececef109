"""The report over runs in the paper's layout: Markdown, CSV, JSON, tables for the terminal."""

from __future__ import annotations

import csv
import io
import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.markup import escape
from rich.table import Table

from tangent_train.tasks.paper import CLASSES, STANFORD_ROWS, PaperRow
from tangent_train.tasks.report import Figure, Group
from tangent_train.tasks.runs import MEANS, PER_CLASS

__all__ = ["MADE_BY", "notes", "report_csv", "report_json", "report_markdown", "report_tables"]

MADE_BY = "tangent-report"
"""Stands in the JSON file: the mark of a report."""

_LEGEND = (
    "Percent. Mean over folds of the mean over seeds; ± the sample standard deviation over folds, "
    "in brackets that over seeds within a fold. The paper's own rows are means over the 3 folds."
)
_MADE_ROOMS = "Made rooms: nothing here is comparable with figures on real data."
_OVERALL = (
    "s", "method", "input", "b", "mAcc", "mIoU", "mAcc by solid angle", "mIoU by solid angle",
    "folds", "runs",
)  # fmt: skip

Cells = tuple[str, ...]


@dataclass(frozen=True)
class _Section:
    """Groups on the same data, as tables of cells; the first row is the header."""

    title: str
    remark: str
    overall: list[Cells]
    per_class: dict[str, list[Cells]]


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
        groups: From `report.group_runs`.
        remarks: Sentences to stand below the tables.
    """
    lines = ["# Report", "", _LEGEND, ""]
    for section in _sections(groups):
        lines += [f"## {section.title}", ""]
        lines += [section.remark, ""] if section.remark else []
        lines += [*_markdown_table(section.overall, left=3), ""]
        for title, cells in section.per_class.items():
            lines += [f"### {title}", "", *_markdown_table(cells, left=1), ""]
    lines += [f"- {remark}" for remark in remarks]
    lines += ["", "| group | fold | seed | run |", "| --- | ---: | ---: | --- |"]
    lines += [
        _line((group.label, _text(run.fold), _text(run.settings.get("seed")), str(run.folder)))
        for group in groups
        for run in group.runs
    ]
    return "\n".join(lines) + "\n"


def report_tables(groups: Sequence[Group]) -> list[Table]:
    """The overall tables for the terminal.

    Args:
        groups: From `report.group_runs`.
    """
    tables = []
    for section in _sections(groups):
        table = Table(title=section.title, caption=section.remark or None)
        header, *rows = section.overall
        for k, name in enumerate(header):
            table.add_column(name, justify="left" if k in {1, 2} else "right")
        for row in rows:
            table.add_row(*map(escape, row), style="dim" if row[1].endswith("(paper)") else None)
        tables.append(table)
    return tables


def report_csv(groups: Sequence[Group]) -> str:
    """One line per group, class ("mean" for all) and figure; shares of 1.

    Args:
        groups: From `report.group_runs`.
    """
    text = io.StringIO()
    columns = ["group", "data", "level", "base_level", "inputs", "runs", "class", "figure"]
    columns += ["mean", "over_folds", "over_seeds", "folds", "paper"]
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    for group in groups:
        for class_name, name, figure, paper in _all_figures(group):
            row = {"group": group.label, "runs": len(group.runs), "class": class_name}
            writer.writerow(row | _facts(group) | {"figure": name, "paper": paper} | asdict(figure))
    return text.getvalue()


def report_json(groups: Sequence[Group], remarks: Sequence[str]) -> str:
    """Everything in the report, figures as shares of 1.

    Args:
        groups: From `report.group_runs`.
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
                        "panoramas": run.results.get("panoramas"),
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
        made = str(members[0].setting("data._target_")).endswith(".SynthRooms")
        printed = _printed_rows(members)
        rows: list[PaperRow | Group] = [*printed, *members]
        ranked = sorted(rows, key=_level)
        per_class = {
            "Accuracy %": _per_class(ranked, members[0].class_names, "accuracy"),
            "IoU %": _per_class(ranked, members[0].class_names, "iou"),
        }
        overall = [_OVERALL, *map(_overall, ranked)]
        sections.append(_Section(title, _MADE_ROOMS if made else "", overall, per_class))
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
        figures = tuple(_text(figure) for figure in (row.macc, row.miou))
        start = (str(row.level), _method(row), row.inputs, str(row.base_level))
        return (*start, *figures, "", "", "3" if row.method == "Ours" else "", "")
    names = ("macc", "miou", "macc_solid_angle", "miou_solid_angle")
    folds = ", ".join(map(str, row.folds)) or "–"
    if row.missing_folds:
        folds += " only"
    start = (_text(row.setting("level")), row.label, row.inputs, str(row.base_level))
    return (*start, *(_cell(row.figure(n), row) for n in names), folds, str(len(row.runs)))


def _per_class(
    rows: Sequence[PaperRow | Group], class_names: Sequence[str], name: str
) -> list[Cells]:
    cells: list[Cells] = [("method", *class_names)]
    for row in rows:
        if isinstance(row, Group):
            cells.append((row.label, *(_cell(f, row) for f in _figures(row, name))))
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


def _cell(figure: Figure, group: Group) -> str:
    if figure.mean is None:
        return "–"
    text = f"{100 * figure.mean:.1f}"
    if figure.over_folds is not None:
        text += f" ± {100 * figure.over_folds:.1f}"
    if figure.over_seeds is not None:
        text += f" (± {100 * figure.over_seeds:.1f})"
    lacking = figure.folds < _folds(group)
    return text + (f" of {figure.folds}" if lacking else "")


def _share(percent: float | None) -> float | None:
    return None if percent is None else percent / 100


def _text(value: object) -> str:
    return "–" if value is None else str(value)


def _markdown_table(rows: Sequence[Cells], left: int) -> list[str]:
    header, *others = rows
    rule = ["---" if k < left else "---:" for k in range(len(header))]
    return [_line(cells) for cells in (header, rule, *others)]


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"
