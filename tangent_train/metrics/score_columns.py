"""Names and units of scores, as reports print them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

_Value = TypeVar("_Value")

SOLID_ANGLE = "_solid_angle"
"""Suffix of the name of a score by solid angle; without it, it is the name of the same score by
pixels."""


@dataclass(frozen=True)
class ScoreColumn:
    """Name and unit of a score in reports.

    Attributes:
        text: Name of the score in reports.
        unit: ``%`` for a share of 1, which is printed in percent; else a unit, or "".
        of_class: Key of the score of one class that this score is the mean of, or "".
        class_text: Name of that score in reports.
        better: ``higher``, or ``lower`` for errors.
        is_main: True if reports of several runs and headlines contain the score; all scores are in
            the files and in the tables of a run.
    """

    text: str
    unit: str = "%"
    of_class: str = ""
    class_text: str = ""
    better: str = "higher"
    is_main: bool = True

    @property
    def title(self) -> str:
        """Title of a column with the score."""
        return f"{self.text} {self.unit}".strip() + " ↓" * (self.better == "lower")

    @property
    def class_title(self) -> str:
        """Title of a column with the score of one class."""
        return f"{self.class_text} {self.unit}".strip()


def by_solid_angle(scores: Mapping[str, _Value]) -> dict[str, _Value]:
    """Rename scores to those by solid angle."""
    return {name + SOLID_ANGLE: value for name, value in scores.items()}


def with_solid_angle(columns: Mapping[str, ScoreColumn]) -> dict[str, ScoreColumn]:
    """Add the columns of the same scores by solid angle.

    Args:
        columns: Columns of scores by pixels.
    """
    return dict(columns) | {
        name + SOLID_ANGLE: replace(
            column,
            text=f"{column.text} by solid angle",
            of_class=column.of_class and column.of_class + SOLID_ANGLE,
            class_text=column.class_text and f"{column.class_text} by solid angle",
        )
        for name, column in columns.items()
    }
