"""Drawing whole groups of pictures, such as rooms, to be held back from training."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np

__all__ = ["draw_groups"]

# What can be sorted: names, or tuples of them and numbers.
_Group = TypeVar("_Group", bound="str | tuple[Any, ...]")


def draw_groups(
    groups: Iterable[_Group], fraction: float, seed: int | Sequence[int]
) -> set[_Group]:
    """Draw some of the groups, the same for the same seed, in whatever order they come.

    Args:
        groups: All there are; those that come several times count once.
        fraction: Share of them to draw: at least one, never all, so none of a single one.
        seed: Of the drawing.

    >>> sorted(draw_groups(["hall", "attic", "kitchen", "hall"], 0.5, seed=0))
    ['attic', 'kitchen']
    """
    ordered = sorted(set(groups))
    if len(ordered) < 2:
        return set()
    count = min(max(1, round(fraction * len(ordered))), len(ordered) - 1)
    order = np.random.default_rng(seed).permutation(len(ordered))
    return {ordered[place] for place in order[:count]}
