"""Names, units and means of scores, shared by all kinds of output."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

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
        of_sphere: True for a score that only panoramas have, see `metrics.sphere`.
    """

    text: str
    unit: str = "%"
    of_class: str = ""
    class_text: str = ""
    better: str = "higher"
    is_main: bool = True
    of_sphere: bool = False

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


TURNS = {"yaw": "under turns about the vertical", "so3": "under random rotations"}
"""Kinds of rotations under which the consistency of a network is measured."""


def sphere_columns(
    text: str, unit: str = "%", better: str = "higher", **consistency: str
) -> dict[str, ScoreColumn]:
    """Return the columns of the scores of panoramas, see `metrics.sphere`.

    Args:
        text: Name of the score that is compared between regions.
        unit: Its unit.
        better: Its better direction.
        **consistency: Texts of the scores of `Head.agreement`, by name.
    """
    how: dict[str, Any] = {"is_main": False, "of_sphere": True}
    gaps = {"pole_gap": "near the poles, minus horizon", "seam_gap": "near the seam, minus others"}
    columns = {
        name: ScoreColumn(f"{text} {of}", unit, better=better, **how) for name, of in gaps.items()
    }
    columns["seam_step"] = ScoreColumn("step across the seam", unit, better="lower", **how)
    return columns | {
        f"consistency_{name}_{turn}": ScoreColumn(f"{text} {under}", better=better, **how)
        for turn, under in TURNS.items()
        for name, text in consistency.items()
    }


BAND_EDGES_DEG = (90, 60, 30, 0, -30, -60, -90)
"""Edges of the latitude bands, from north to south. A row whose center is on an edge belongs to the
northern band."""

Interval = tuple[float, float]
"""Lower and upper end of a score, shares of 1."""


def band_of_rows(height: int) -> NDArray[np.intp]:
    """Return the index of the latitude band of each row of a panorama, see `BAND_EDGES_DEG`."""
    # In degrees, with the division last, so that a row on an edge has no rounding error.
    southward_deg = (2 * np.arange(height) + 1) * 90 / height - 90
    return np.searchsorted(-np.array(BAND_EDGES_DEG[1:-1]), southward_deg, side="left")


def defined_mean(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean over the last axis without NaN; NaN if all values are NaN."""
    count = np.sum(~np.isnan(scores), axis=-1)
    total = np.nansum(scores, axis=-1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
