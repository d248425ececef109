"""The paper's figures beside those of a transfer."""

from __future__ import annotations

from typing import Literal

from datamodules.stanford2d3ds.files import FOLDS
from tangent_train.results.reports.cells import Cells, change, text
from tangent_train.results.reports.groups import REAL
from tangent_train.results.reports.paper import CLASSES
from tangent_train.results.transfer.paper import (
    SYNTHIA_ROWS,
    TRANSFER_SETTING,
    TRANSFER_STAGES,
    PaperStage,
    paper_stage,
    synthia_row,
)
from tangent_train.results.transfer.report import Row, TransferReport

__all__ = ["paper_notes", "paper_table", "paper_tables", "printed", "printed_kept"]

_TABLES: dict[object, Literal["stanford", "omnisynthia"]] = {
    REAL: "stanford",
    "datamodules.OmniSynthia": "omnisynthia",
}
_MADE = "datamodules.SynthRooms"
_FOLD_MEANS = (
    'The paper\'s figures over folds are means of its printed folds: its rows "ALL FOLDS" repeat '
    "fold 3 digit for digit."
)


def paper_table(report: TransferReport) -> Literal["stanford", "omnisynthia"] | None:
    """Which of the paper's tables has figures on the same data.

    None for made rooms, whose figures say nothing about real ones, and for turned panoramas.
    """
    runs = [result.run for row in report.panoramas for result in row.results]
    targets = {run.settings.get("data._target_") for run in runs}
    turned = any(run.settings.get("data.test_rotation") is not None for run in runs)
    if len(targets) != 1 or turned:
        return None
    table = _TABLES.get(targets.pop())
    return None if table == "stanford" and report.class_names != CLASSES else table


def printed(
    report: TransferReport, row: Row, name: str, class_index: int | None = None
) -> float | None:
    """The paper's figure for the same data and stage, a share of 1; None where there is none.

    Args:
        report: The row's; over folds, the paper's figure is over those that the row has.
        row: A stage.
        name: As in `Row.figure`.
        class_index: Likewise; printed over all 3 folds only.
    """
    table = paper_table(report)
    percent: float | None = None
    if table == "stanford" and (stage := _same_stage(row)) is not None:
        if class_index is None:
            percent = stage.figure(name, row.folds)
        elif row.folds == tuple(FOLDS) and (of_classes := getattr(stage, name, ())):
            percent = of_classes[class_index]
    elif table == "omnisynthia" and class_index is None and row.kind.representation == "tangent":
        level = row.kind.run.settings.get("level")
        percent = getattr(synthia_row(int(level or 0), row.name), name, None)
    return None if percent is None else percent / 100


def printed_kept(
    report: TransferReport, row: Row, name: str, class_index: int | None = None
) -> float | None:
    """What the paper kept of the figure on photos, from its printed figures; a share of 1.

    Args:
        report: As in `printed`.
        row: Likewise.
        name: Likewise.
        class_index: Likewise.
    """
    if row.partner is None:
        return None
    both = [fold for fold in row.folds if fold in row.partner.folds]
    own, base = (
        printed(report, Row(part), name, class_index) if part else None
        for part in (
            tuple(result for result in of_row.results if result.fold in both)
            for of_row in (row, row.partner)
        )
    )
    return own / base if own is not None and base else None


def paper_tables(report: TransferReport) -> list[tuple[str, list[Cells]]]:
    """Tables of the paper to stand below, with titles; none for data it knows nothing of."""
    table = paper_table(report)
    if table == "stanford":
        return [
            ("The paper's classes: accuracy %, mean of 3 folds", _classes("accuracy")),
            ("The paper's classes: IoU %, mean of 3 folds", _classes("iou")),
        ]
    if table == "omnisynthia":
        rows: list[Cells] = [("s", "method", "training on panoramas", "mAcc %", "mIoU %")]
        rows += [
            (str(row.level), row.method, row.training, f"{row.macc:.1f}", f"{row.miou:.1f}")
            for row in SYNTHIA_ROWS
        ]
        return [("The paper's comparison on OmniSYNTHIA", rows)]
    if report.group is not None and report.group.setting("data._target_") == _MADE:
        return [("The paper, on Stanford2D3DS (real rooms; not comparable)", _stages())]
    return []


def paper_notes(report: TransferReport) -> list[str]:
    """What has to be known about the paper's figures where they stand beside."""
    if report.group is None or not any(printed(report, row, "miou") for row in report.rows):
        return []
    synthia = paper_table(report) == "omnisynthia"
    wanted = {"base_level": 1, "inputs": "RGB"} if synthia else TRANSFER_SETTING
    found = {
        "level": report.group.setting("level"),
        "base_level": report.group.base_level,
        "inputs": report.group.inputs,
    }
    differing = [
        f"{name.replace('_', ' ')} {paper}, here {text(found[name])}"
        for name, paper in wanted.items()
        if found[name] != paper
    ]
    other = f"The paper's transfer was run with {'; '.join(differing)}."
    return [*([] if synthia else [_FOLD_MEANS]), *([other] if differing else [])]


def _same_stage(row: Row) -> PaperStage | None:
    """The paper's stage of that name, if it was run in the paper's way."""
    stage = paper_stage(row.name)
    if stage is None:
        return None
    ours = (row.kind.on, row.kind.epochs, row.kind.representation)
    way = "perspective" if stage.on == "photos" else "tangent"
    return stage if ours == (stage.on, stage.epochs, way) else None


def _stages() -> list[Cells]:
    rows: list[Cells] = [("stage", "mAcc %", "change", "mIoU %", "change")]
    for stage in TRANSFER_STAGES:
        cells: Cells = (stage.name,)
        for name in ("macc", "miou"):
            own = stage.figure(name, tuple(FOLDS))
            base = None if stage.partner is None else stage.partner.figure(name, tuple(FOLDS))
            if own is not None:
                cells += (f"{own:.1f}", change(own / base if base else None))
        rows.append(cells)
    return rows


def _classes(name: Literal["accuracy", "iou"]) -> list[Cells]:
    header: Cells = ("class",)
    stages = [stage for stage in TRANSFER_STAGES if getattr(stage, name)]
    for stage in stages:
        header += (stage.name, "change") if stage.partner else (stage.name,)
    rows = [header]
    for k, class_name in enumerate(CLASSES):
        cells: Cells = (class_name,)
        for stage in stages:
            own = getattr(stage, name)[k]
            cells += (f"{own:.1f}",)
            cells += (change(own / getattr(stage.partner, name)[k]),) if stage.partner else ()
        rows.append(cells)
    return rows
