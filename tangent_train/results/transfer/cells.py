"""The tables of a transfer, as cells."""

from __future__ import annotations

from tangent_train.results.reports.cells import Cells, cell, change, kept, percent, text
from tangent_train.results.reports.groups import Figure
from tangent_train.results.transfer.beside_paper import paper_table, printed, printed_kept
from tangent_train.results.transfer.report import TransferReport

__all__ = ["band_cells", "class_cells", "overall_cells", "scope_text"]

_RUN_ON = {"perspective": "photos", "tangent": "tangent images", "erp": "ERP"}


def scope_text(report: TransferReport) -> str:
    """What the figures of a report are over."""
    folds = [text(fold) for fold in report.folds]
    if len(folds) > 1:
        return f"mean of folds {', '.join(folds[:-1])} and {folds[-1]}"
    return "one test set" if report.folds == (None,) else f"fold {folds[0]}"


def overall_cells(report: TransferReport, *, short: bool = False) -> list[Cells]:
    """A line per stage: mAcc and mIoU, what of them is kept, and the paper's; header first.

    Args:
        report: All folds, or one of them.
        short: Without the spreads of what is kept, for the terminal.
    """
    table = paper_table(report)
    of_photos: Cells = ("change (kept)",) if short else ("change", "kept")
    header: Cells = ("stage", "run on", "mAcc %", *of_photos, "mIoU %", *of_photos)
    header += ("mIoU % by solid angle",) if short else ("mIoU % by solid angle", "kept")
    for name in ("paper mAcc %", "paper mIoU %") if table else ():
        header += (name, "change") if table == "stanford" else (name,)
    rows = [header]
    for row in report.rows:
        cells: Cells = (row.name, _RUN_ON.get(row.kind.representation, row.kind.representation))
        for name in ("macc", "miou"):
            cells += (cell(row.figure(name), len(row.folds)), *_kept(row.kept(name), short=short))
        cells += (cell(row.figure("miou_solid_angle"), len(row.folds)),)
        cells += () if short else (kept(row.kept("miou_solid_angle")),)
        for name in ("macc", "miou") if table else ():
            cells += (percent(printed(report, row, name)),)
            cells += (change(printed_kept(report, row, name)),) if table == "stanford" else ()
        rows.append(cells)
    return rows


def _kept(figure: Figure, *, short: bool) -> Cells:
    if figure.mean is None:
        return ("–",) if short else ("–", "–")
    beside = change(figure.mean)
    return (f"{beside} ({percent(figure.mean)} %)",) if short else (beside, kept(figure))


def class_cells(report: TransferReport, name: str) -> list[Cells]:
    """A line per class: a figure of every stage and its change from photos; header first.

    Args:
        report: All folds, or one of them.
        name: One of `runs.PER_CLASS`.
    """
    header: Cells = ("class",)
    for row in report.rows:
        header += (row.name, "change") if row.partner else (row.name,)
    rows = [header]
    for k, class_name in enumerate(report.class_names):
        cells: Cells = (class_name,)
        for row in report.rows:
            cells += (percent(row.figure(name, k).mean),)
            cells += (change(row.kept(name, k).mean),) if row.partner else ()
        rows.append(cells)
    return rows


def band_cells(report: TransferReport) -> list[Cells]:
    """A line per band of latitude: mIoU of every stage on panoramas; header first.

    Args:
        report: All folds, or one of them.

    Returns:
        Nothing where no stage has bands.
    """
    rows = [row for row in report.panoramas if row.bands]
    bands = dict.fromkeys(band for row in rows for band in row.bands)
    if not bands:
        return []
    return [
        ("latitude", *(row.name for row in rows)),
        *(
            (
                f"{band[0]:g}° … {band[1]:g}°".replace("-", "−"),
                *(percent(row.figure("miou", band=band).mean) for row in rows),
            )
            for band in bands
        ),
    ]
