"""A part of a report over runs, whatever they have learned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tangent_train.results.reports.cells import Cells, cell
from tangent_train.results.reports.groups import Figure, Group

__all__ = ["Section", "class_cells", "class_figures", "fold_count"]


@dataclass(frozen=True)
class Section:
    """Groups on the same data, as tables of cells; the first row is the header.

    Attributes:
        title: The data.
        remark: What has to be known of it.
        overall: Figures over all classes, a row per group.
        texts: How many columns of `overall`, from the left, are text.
        per_class: Tables of a figure of each class, by its name.
        losses: The worst class of each group, a sentence.
    """

    title: str
    remark: str
    overall: list[Cells]
    texts: int
    per_class: dict[str, list[Cells]]
    losses: list[str]


def fold_count(group: Group) -> int:
    """How many folds its figures should be over."""
    return len(group.folds) or 1


def class_figures(group: Group, name: str) -> list[Figure]:
    """A figure of every class."""
    return [group.figure(name, k) for k in range(len(group.class_names))]


def class_cells(group: Group, name: str) -> Sequence[str]:
    """A figure of every class as text."""
    return [cell(figure, fold_count(group)) for figure in class_figures(group, name)]
