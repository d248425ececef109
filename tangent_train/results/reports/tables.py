"""The report over runs in the paper's layout: Markdown, CSV, JSON, tables for the terminal."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rich.table import Table

from tangent_train.csv_text import csv_text
from tangent_train.results.reports.cells import line, markdown_table, terminal_table, text
from tangent_train.results.reports.classification import classification_sections, rotations
from tangent_train.results.reports.groups import Figure, Group
from tangent_train.results.reports.runs import FIGURES, Run
from tangent_train.results.reports.section import Section, class_figures, fold_count
from tangent_train.results.reports.segmentation import MADE_ROOMS, segmentation_sections

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

_LEGENDS = {
    "segmentation": "Percent. Mean over folds of the mean over seeds; ± the sample standard "
    "deviation over folds, in brackets that over seeds within a fold. The paper's own rows are "
    "means over the 3 folds.",
    "classification": "Percent. Mean over seeds, in brackets ± the sample standard deviation. "
    "Accuracy is the share of all shapes; the mean of the classes counts every class the same. "
    "Shapes were turned in training / in the test: – not, z about the vertical, SO3 any way.",
}
"""By the kind of the groups."""

_SECTIONS: Mapping[str, Callable[[Sequence[Group]], list[Section]]] = {
    "segmentation": segmentation_sections,
    "classification": classification_sections,
}
"""By the kind of the groups."""


def notes(groups: Sequence[Group]) -> list[str]:
    """What has to be known beside the figures: folds that lack, runs that are there twice."""
    found = []
    for group in groups:
        if group.missing_folds:
            lacking = " and ".join(map(str, group.missing_folds))
            found.append(f"{group.label}: fold {lacking} missing; not a mean of 3 folds.")
        found += [
            f"{group.label}: {_fold_and_seed(run)} more than once, also in {run.folder}."
            for run in group.repeated
        ]
        figures = class_figures(group, FIGURES[group.kind].worst)
        absent = [
            f"{name} ({figure.folds} of {fold_count(group)})"
            for name, figure in zip(group.class_names, figures, strict=True)
            if figure.folds < fold_count(group)
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
    lines = ["# Report", "", _LEGENDS[groups[0].kind], ""]
    for section in _SECTIONS[groups[0].kind](groups):
        lines += [f"## {section.title}", ""]
        lines += [section.remark, ""] if section.remark else []
        lines += [*markdown_table(section.overall, section.texts), ""]
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
            range(1, section.texts),
            "\n".join(filter(None, (section.remark, *section.losses))),
        )
        for section in _SECTIONS[groups[0].kind](groups)
    ]


def report_csv(groups: Sequence[Group]) -> str:
    """One line per group, class ("mean" for all) and figure; shares of 1.

    Args:
        groups: From `groups.group_runs`.
    """
    columns = ["group", *_facts(groups[0]), "runs", "class", "figure"]
    columns += ["mean", "over_folds", "over_seeds", "folds", "paper"]
    rows = []
    for group in groups:
        for class_name, name, figure, paper in _all_figures(group):
            row = {"group": group.label, "runs": len(group.runs), "class": class_name}
            rows.append(row | _facts(group) | {"figure": name, "paper": paper} | asdict(figure))
    return csv_text(columns, rows)


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
    facts = {
        "data": group.data,
        "level": group.setting("level"),
        "base_level": group.base_level,
    }
    if group.kind == "classification":
        return facts | {"rotations": rotations(group)}
    return facts | {"inputs": group.inputs}


def _all_figures(group: Group) -> Iterator[tuple[str, str, Figure, float | None]]:
    """Class ("mean" for all), name, figure, and the paper's as a share of 1."""
    paper = group.paper
    names = FIGURES[group.kind]
    for name in names.means:
        printed = getattr(paper, name, None)
        yield "mean", name, group.figure(name), _share(printed)
    for k, class_name in enumerate(group.class_names):
        for name in names.per_class:
            of_classes = getattr(paper, name, None)
            printed = of_classes[k] if of_classes else None
            yield class_name, name, group.figure(name, k), _share(printed)


def _share(percent: float | None) -> float | None:
    return None if percent is None else percent / 100


def _fold_and_seed(run: Run) -> str:
    fold = "" if run.fold is None else f"fold {run.fold}, "
    return f"{fold}seed {run.settings.get('seed')}"
