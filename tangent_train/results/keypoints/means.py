"""Means over pairs, as in the paper's tables, and the paper's own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tangent_train.results.keypoints.entries import EASY, HARD, PairEntry, Scored

__all__ = ["PAPER", "PAPER_STATISTICS", "SCORES", "SplitMeans", "mean_of", "splits_of"]

SCORES = ("pmr", "ms", "p")
"""Putative matching ratio, matching score, precision."""

PAPER: dict[str, dict[str, tuple[float, float, float, float]]] = {
    HARD: {
        "pmr": (0.222, 0.284, 0.301, 0.274),
        "ms": (0.082, 0.111, 0.117, 0.109),
        "p": (0.369, 0.395, 0.396, 0.402),
    },
    EASY: {
        "pmr": (0.263, 0.324, 0.346, 0.319),
        "ms": (0.136, 0.166, 0.177, 0.161),
        "p": (0.460, 0.464, 0.475, 0.465),
    },
}
"""The paper's table of keypoint metrics: ERP, L0, L1, L2 of each split."""

PAPER_STATISTICS = {HARD: (30, 0.8335, 298), EASY: (30, 0.8935, 515)}
"""Its table of statistics: pairs, mean overlap, mean inliers on the equirectangular images."""


@dataclass(frozen=True)
class SplitMeans:
    """Means over the pairs of one split.

    Attributes:
        split: Its name; None for all pairs of data without splits.
        entries: Its pairs.
    """

    split: str | None
    entries: tuple[PairEntry, ...]

    @property
    def fov_overlap(self) -> float | None:
        """Mean overlap of the fields of view."""
        return mean_of(entry.fov_overlap for entry in self.entries)

    def mean(
        self, condition: str, representation: str, figure: Callable[[Scored], float | None]
    ) -> float | None:
        """Mean over the pairs, without those of which the figure is not defined."""
        return mean_of(map(figure, self._scored(condition, representation)))

    def median(
        self, condition: str, representation: str, figure: Callable[[Scored], float | None]
    ) -> float | None:
        """Median over the pairs, likewise."""
        known = [v for v in map(figure, self._scored(condition, representation)) if v is not None]
        return float(np.median(known)) if known else None

    def _scored(self, condition: str, representation: str) -> list[Scored]:
        found = (entry.of_condition(condition) for entry in self.entries)
        return [scored[representation] for scored in found if representation in scored]


def splits_of(entries: Sequence[PairEntry]) -> list[SplitMeans]:
    """Hard and easy pairs, then other splits, as they are named; see `with_splits`."""
    names = {entry.split for entry in entries}
    ordered = [name for name in (HARD, EASY) if name in names]
    ordered += sorted(str(name) for name in names - {HARD, EASY, None})
    splits: list[str | None] = [*ordered, *[None] * (None in names)]
    return [SplitMeans(s, tuple(e for e in entries if e.split == s)) for s in splits]


def mean_of(values: Iterable[float | None]) -> float | None:
    """Mean of those that are defined; None where none is."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
