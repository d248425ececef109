"""Which class a transfer costs most."""

from __future__ import annotations

from tangent_train.results.reports.cells import percent
from tangent_train.results.reports.groups import average
from tangent_train.results.reports.losses import is_labelled
from tangent_train.results.transfer.report import Row, TransferReport

__all__ = ["largest_losses"]


def largest_losses(report: TransferReport) -> list[str]:
    """For every stage on panoramas the class that loses most IoU against photos, in points.

    Figures are over the folds and seeds in which both stages have the class.

    Args:
        report: All folds, or one of them.

    Returns:
        A sentence per stage; none for stages without photos beside them or without such a class.
    """
    sentences = []
    for row in report.panoramas:
        if row.partner is None:
            continue
        figures = (_both(row, row.partner, k) for k in range(len(report.class_names)))
        changes = [
            (own - before, name, before, own)
            for name, pair in zip(report.class_names, figures, strict=True)
            if pair is not None
            for before, own in (pair,)
        ]
        if not changes:
            continue
        change, name, before, own = min(changes, key=lambda found: found[0])
        what = f"{name} loses most IoU from {row.partner.name}"
        if change >= 0:
            what = f"no class loses IoU from {row.partner.name}, {name} gains least"
        sentences.append(f"{row.name}: {what}: {percent(before)} % to {percent(own)} %.")
    return sentences


def _both(row: Row, partner: Row, class_index: int) -> tuple[float, float] | None:
    """A class's IoU of the partner and of the row, over the folds and seeds that both have."""
    own, before = (
        {
            (result.fold, result.seed): result.run.figure("iou", class_index)
            for result in of.results
            if is_labelled(result.run, class_index)
        }
        for of in (row, partner)
    )
    pairs = [
        (key[0], before[key], value)
        for key, value in own.items()
        if value is not None and before.get(key) is not None
    ]
    means = [average([(pair[0], pair[k] or 0.0) for pair in pairs]).mean for k in (1, 2)]
    return None if means[0] is None or means[1] is None else (means[0], means[1])
