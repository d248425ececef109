"""Tables of classification runs in the paper's layout, by how shapes were turned."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from datamodules.modelnet40.shape_files import MODELNET40
from tangent_train.results.reports.cells import Cells, cell, text
from tangent_train.results.reports.groups import Group
from tangent_train.results.reports.losses import largest_losses
from tangent_train.results.reports.paper import SHAPE_DATA, SHAPE_ROWS
from tangent_train.results.reports.section import Section, class_cells, fold_count

__all__ = ["MADE_SHAPES", "classification_sections", "rotations"]

MADE_SHAPES = "Made shapes: nothing here is comparable with figures on ModelNet40."
"""Stands beside figures of `SynthShapes`."""

_OVERALL = (
    "s", "method", "train / test", "b", "accuracy", "mean of classes", "shapes", "runs",
)  # fmt: skip
_TURNS = {None: "–", "none": "–", "yaw": "z", "so3": "SO3"}
"""The field's names of rotations: none, about the vertical axis, any."""


def rotations(group: Group) -> str:
    """How shapes were turned in training and test, as in "z / SO3"."""
    turns = (group.setting(name) for name in ("representation.rotation", "data.test_rotation"))
    return " / ".join(_TURNS.get(turn, str(turn)) for turn in turns)


def classification_sections(groups: Sequence[Group]) -> list[Section]:
    """Groups by their data, beside the paper's table where it is that of the paper.

    Args:
        groups: From `groups.group_runs`.
    """
    of_data: dict[str, list[Group]] = defaultdict(list)
    for group in groups:
        of_data[group.data].append(group)
    sections = []
    for title, members in of_data.items():
        target, names = str(members[0].setting("data._target_")), members[0].class_names
        # The same reader reads other trees, as ModelNet10's.
        paper = target == SHAPE_DATA and names == MODELNET40
        printed = [_printed(*row) for row in SHAPE_ROWS] if paper else []
        accuracy = [
            ("method", *names),
            *((group.label, *class_cells(group, "accuracy")) for group in members),
        ]
        sections.append(
            Section(
                title,
                MADE_SHAPES if target.endswith(".SynthShapes") else "",
                [_OVERALL, *printed, *map(_overall, members)],
                3,
                {"Accuracy %": accuracy},
                largest_losses(members),
            )
        )
    return sections


def _printed(method: str, accuracy: float) -> Cells:
    return ("5", f"{method} (paper)", "", "", f"{accuracy:.1f}", "", "", "")


def _overall(group: Group) -> Cells:
    figures = (group.figure(name) for name in ("accuracy", "class_accuracy"))
    return (
        text(group.setting("level")),
        group.label,
        rotations(group),
        str(group.base_level),
        *(cell(figure, fold_count(group)) for figure in figures),
        text(group.runs[0].images),
        str(len(group.runs)),
    )
