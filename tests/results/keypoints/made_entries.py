"""Entries with figures that are easy to follow."""

from __future__ import annotations

from collections.abc import Sequence

from tangent_train.results.keypoints.entries import AS_GIVEN, PairEntry, Scored


def scored(
    representation: str,
    pmr: float | None,
    ms: float | None = 0.1,
    p: float | None = 0.5,
    condition: str = AS_GIVEN,
    **more: float,
) -> Scored:
    """Figures of one representation."""
    counts = (100, 120, 80, 90, 40, 20)
    return Scored(condition, representation, *counts, pmr, ms, p, "general", **more)  # type: ignore[arg-type]


def entry(
    name: str,
    found: Sequence[Scored],
    overlap: float | None = None,
    split: str | None = None,
    *,
    has_geometry: bool = False,
) -> PairEntry:
    """An entry of one pair."""
    return PairEntry(
        name, split, f"{name}_left", f"{name}_right", 512, 8, overlap, has_geometry, tuple(found)
    )
