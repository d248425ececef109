"""Tables of segmentation runs in the paper's layout."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from tangent_train.results.reports.cells import Cells, cell, text
from tangent_train.results.reports.groups import Group
from tangent_train.results.reports.losses import largest_losses
from tangent_train.results.reports.paper import CLASSES, STANFORD_ROWS, PaperRow
from tangent_train.results.reports.section import Section, class_cells, fold_count

__all__ = ["MADE_ROOMS", "segmentation_sections"]

MADE_ROOMS = "Made rooms: nothing here is comparable with figures on real data."
"""Stands beside figures of `SynthRooms`."""

_OVERALL = (
    "s", "method", "input", "b", "mAcc", "mIoU", "mAcc by solid angle", "mIoU by solid angle",
    "folds", "runs",
)  # fmt: skip


def segmentation_sections(groups: Sequence[Group]) -> list[Section]:
    """Groups by their data, beside the paper's rows for the same.

    Args:
        groups: From `groups.group_runs`.
    """
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
        sections.append(Section(title, remark, overall, 3, per_class, losses))
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
    return (
        *start,
        *(cell(row.figure(n), fold_count(row)) for n in names),
        folds,
        str(len(row.runs)),
    )


def _per_class(
    rows: Sequence[PaperRow | Group], class_names: Sequence[str], name: str
) -> list[Cells]:
    cells: list[Cells] = [("method", *class_names)]
    for row in rows:
        if isinstance(row, Group):
            cells.append((row.label, *class_cells(row, name)))
        elif getattr(row, name) and tuple(class_names) == CLASSES:
            method = f"{_method(row)}, level {row.level}"
            cells.append((method, *(f"{figure:.1f}" for figure in getattr(row, name))))
    return cells


def _method(row: PaperRow) -> str:
    return "tangent images (paper)" if row.method == "Ours" else f"{row.method} (paper)"
