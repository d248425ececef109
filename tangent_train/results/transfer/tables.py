"""The report of a transfer: Markdown, CSV, JSON, tables for the terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from tangent_train.csv_text import csv_text
from tangent_train.results.reports.cells import line, markdown_table, terminal_table, text
from tangent_train.results.reports.groups import Figure
from tangent_train.results.reports.runs import MEANS, PER_BAND, PER_CLASS
from tangent_train.results.reports.tables import MADE_ROOMS
from tangent_train.results.transfer.beside_paper import paper_notes, paper_tables, printed
from tangent_train.results.transfer.cells import (
    band_cells,
    class_cells,
    overall_cells,
    scope_text,
)
from tangent_train.results.transfer.losses import largest_losses
from tangent_train.results.transfer.report import Row, TransferReport

__all__ = [
    "MADE_BY",
    "transfer_csv",
    "transfer_json",
    "transfer_markdown",
    "transfer_notes",
    "transfer_tables",
]

MADE_BY = "tangent-transfer"
"""Stands in the JSON files: the mark of such a report."""

_LEGEND = (
    "Percent. Over folds: mean over folds of the mean over seeds; ± the sample standard deviation "
    "over folds, in brackets that over seeds within a fold. Change and kept: the figure on "
    "panoramas against that on photos with as many epochs of fine-tuning, over folds the ratio of "
    "the means."
)


@dataclass(frozen=True)
class _Entry:
    """A figure of a row and what stands beside it.

    Attributes:
        class_name: "mean" for all classes.
        band: South and north in degrees; None for all latitudes.
        name: Of the figure.
        figure: Its mean and spreads.
        kept: What is kept of the photos' figure.
        paper: The paper's, a share of 1.
    """

    class_name: str
    band: tuple[float, float] | None
    name: str
    figure: Figure
    kept: Figure
    paper: float | None


def transfer_notes(report: TransferReport) -> list[str]:
    """What has to be known beside the figures.

    Args:
        report: From `report.gather`.
    """
    notes = []
    for row in report.rows:
        missing = [str(fold) for fold in report.folds if fold not in row.folds]
        if missing:
            notes.append(f"{row.name}: fold {' and '.join(missing)} missing.")
        if row.kind.on == "panoramas" and row.partner is None:
            epochs = row.kind.epochs
            notes.append(f"{row.name}: no photos with {epochs} epochs of fine-tuning beside it.")
        if row.partner is not None and row.members != row.partner.members:
            notes.append(
                f"{row.name} and {row.partner.name} have other folds and seeds; what is kept is "
                "over those that both have."
            )
        figures = [row.figure("iou", k) for k in range(len(report.class_names))]
        absent = [
            f"{name} ({figure.folds} of {len(row.folds)})"
            for name, figure in zip(report.class_names, figures, strict=True)
            if figure.folds < len(row.folds)
        ]
        if absent:
            notes.append(
                f"{row.name}: classes not in every fold: {', '.join(absent)}. Where absent, they "
                "are left out of the means."
            )
    return notes + paper_notes(report)


def transfer_markdown(report: TransferReport) -> str:
    """The report as Markdown.

    Args:
        report: From `report.gather`.
    """
    lines = ["# Transfer from photos to panoramas", "", _LEGEND, ""]
    lines += [_data(report), ""] if report.group else []
    for title, part in _parts(report):
        heading = title[0].upper() + title[1:]
        lines += [f"## {heading}", "", *markdown_table(overall_cells(part), left=2), ""]
    for title, name in (("accuracy", "accuracy"), ("IoU", "iou")):
        rows = class_cells(report, name)
        lines += [
            f"## Classes: {title} %, {scope_text(report)}",
            "",
            *markdown_table(rows, left=1),
            "",
        ]
    losses = [f"- {sentence}" for sentence in largest_losses(report)]
    lines += [*losses, ""] if losses else []
    bands = band_cells(report)
    if bands:
        title = f"## mIoU % by latitude, {scope_text(report)}"
        lines += [title, "", *markdown_table(bands, left=1), ""]
    for title, rows in paper_tables(report):
        lines += [f"## {title}", "", *markdown_table(rows, left=1), ""]
    notes = [f"- {note}" for note in transfer_notes(report)]
    lines += [*notes, ""] if notes else []
    lines += ["| stage | fold | seed | run |", "| --- | ---: | ---: | --- |"]
    lines += [
        line((row.name, text(result.fold), str(result.seed), str(result.run.folder)))
        for row in report.rows
        for result in row.results
    ]
    return "\n".join(lines) + "\n"


def transfer_tables(report: TransferReport) -> list[Table]:
    """The table over folds for the terminal with the first stage's loss, and that by latitude.

    Args:
        report: From `report.gather`.
    """
    title, whole = _parts(report)[-1]
    facts = [_data(report)] if report.group else []
    caption = "\n".join([*facts, *largest_losses(report)[:1]])
    tables = [
        terminal_table(f"Transfer: {title}", overall_cells(whole, short=True), (0, 1), caption)
    ]
    bands = band_cells(report)
    return [*tables, terminal_table("mIoU % by latitude", bands, (0,))] if bands else tables


def transfer_csv(report: TransferReport) -> str:
    """One line per stage, fold ("mean" over all), class, band of latitude and figure; shares of 1.

    Args:
        report: From `report.gather`.
    """
    columns = ["stage", "on", "epochs", "representation", "fold", "class", "south", "north"]
    columns += ["figure", "mean", "over_folds", "over_seeds", "folds"]
    columns += ["kept", "kept_over_folds", "kept_over_seeds", "paper"]
    rows = []
    for fold, part in _scopes(report):
        for row in part.rows:
            facts = _facts(row) | {"fold": fold}
            for entry in _entries(part, row):
                south, north = entry.band or (None, None)
                where = {"class": entry.class_name, "south": south, "north": north}
                beside = {
                    "kept": entry.kept.mean,
                    "kept_over_folds": entry.kept.over_folds,
                    "kept_over_seeds": entry.kept.over_seeds,
                    "paper": entry.paper,
                }
                figures = {"figure": entry.name} | asdict(entry.figure)
                rows.append(facts | where | figures | beside)
    return csv_text(columns, rows)


def transfer_json(report: TransferReport) -> str:
    """Everything in the report, figures as shares of 1.

    Args:
        report: From `report.gather`.
    """
    content = {
        "made_by": MADE_BY,
        "study": "transfer",
        "unit": "shares of 1",
        "data": _setting(report),
        "folds": list(report.folds),
        "seeds": list(report.seeds),
        "classes": list(report.class_names),
        "scopes": [
            {"fold": fold, "stages": [_stage(part, row) for row in part.rows]}
            for fold, part in _scopes(report)
        ],
        "runs": [
            {
                "stage": row.name,
                "fold": result.fold,
                "seed": result.seed,
                "folder": str(result.run.folder),
                "images": result.run.images,
            }
            for row in report.rows
            for result in row.results
        ],
        "notes": transfer_notes(report),
    }
    return json.dumps(content, indent=1) + "\n"


def _stage(report: TransferReport, row: Row) -> dict[str, Any]:
    means: dict[str, Any] = {}
    classes: dict[str, dict[str, Any]] = {name: {} for name in report.class_names}
    bands: dict[tuple[float, float], dict[str, Any]] = {band: {} for band in row.bands}
    for entry in _entries(report, row):
        if entry.band is not None:
            bands[entry.band][entry.name] = asdict(entry.figure)
            continue
        into = means if entry.class_name == "mean" else classes[entry.class_name]
        beside = {"kept": asdict(entry.kept), "paper": entry.paper}
        into[entry.name] = asdict(entry.figure) | beside
    return {
        **_facts(row),
        "compared_with": None if row.partner is None else row.partner.name,
        "means": means,
        "classes": classes,
        "latitude_bands": [{"latitude_deg": list(band), **bands[band]} for band in row.bands],
    }


def _entries(report: TransferReport, row: Row) -> Iterator[_Entry]:
    for name in MEANS:
        beside = printed(report, row, name)
        yield _Entry("mean", None, name, row.figure(name), row.kept(name), beside)
    for k, class_name in enumerate(report.class_names):
        for name in PER_CLASS:
            beside = printed(report, row, name, k)
            yield _Entry(class_name, None, name, row.figure(name, k), row.kept(name, k), beside)
    nothing = Figure(None, None, None, 0)
    for band in row.bands:
        for name in PER_BAND:
            yield _Entry("mean", band, name, row.figure(name, band=band), nothing, None)


def _facts(row: Row) -> dict[str, Any]:
    return {
        "stage": row.name,
        "on": row.kind.on,
        "epochs": row.kind.epochs,
        "representation": row.kind.representation,
    }


def _scopes(report: TransferReport) -> list[tuple[int | str | None, TransferReport]]:
    """The folds, each with its part of the report, and "mean" over all of them."""
    return [*((fold, report.of_fold(fold)) for fold in report.folds), ("mean", report)]


def _parts(report: TransferReport) -> list[tuple[str, TransferReport]]:
    """Titles and what stands below; the last is over all folds."""
    if len(report.folds) == 1:
        return [(scope_text(report), report)]
    return [
        *((f"Fold {text(fold)}", report.of_fold(fold)) for fold in report.folds),
        (scope_text(report), report),
    ]


def _setting(report: TransferReport) -> dict[str, Any]:
    group = report.group
    if group is None:
        return {}
    return {
        "name": group.data,
        "level": group.setting("level"),
        "base_level": group.base_level,
        "inputs": group.inputs,
    }


def _data(report: TransferReport) -> str:
    setting = _setting(report)
    facts = (f"{setting['name']}, level {setting['level']}", setting["inputs"])
    made = f" {MADE_ROOMS}" if setting["name"].startswith("SynthRooms") else ""
    return f"Panoramas: {', '.join(facts)}.{made}"
