"""Splits of a data set: training, validation and test."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeVar

import numpy as np

from datamodules.core.cache import Files

Split = Literal["train", "val", "test"]
"""A split of a data set."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
"""All splits, in order."""

_Files = TypeVar("_Files", bound=Files)

# Sortable keys: names, or tuples of names and numbers.
_Group = TypeVar("_Group", bound="str | tuple[Any, ...]")


def draw_groups(
    groups: Iterable[_Group], fraction: float, seed: int | Sequence[int]
) -> set[_Group]:
    """Draw some of the groups; the draw depends on the seed, not on the order of the groups.

    Args:
        groups: All groups; repeated groups count once.
        fraction: Share of the groups to draw: at least one group and at most all but one.
        seed: Seed of the draw.

    >>> sorted(draw_groups(["hall", "attic", "kitchen", "hall"], 0.5, seed=0))
    ['attic', 'kitchen']
    """
    ordered = sorted(set(groups))
    if len(ordered) < 2:
        return set()
    count = min(max(1, round(fraction * len(ordered))), len(ordered) - 1)
    order = np.random.default_rng(seed).permutation(len(ordered))
    return {ordered[place] for place in order[:count]}


def published_splits(
    splits: Mapping[Split, Sequence[_Files]],
    test_split: Literal["test", "val"],
    fraction: float,
    seed: int,
) -> dict[Split, Sequence[_Files]]:
    """Return published splits, with one of them for the test.

    If the published validation items are tested, scenes are drawn from the training items for
    validation, so that nothing is selected on the tested items.

    Args:
        splits: Items of each published split, named ``<scene>/…``.
        test_split: Published split to test on.
        fraction: Share of the training scenes to draw; 0 for no validation in either case.
        seed: Seed of the draw.
    """
    if test_split == "test":
        return dict(splits) if fraction else {**splits, "val": []}
    scenes = [item.name.partition("/")[0] for item in splits["train"]]
    held = draw_groups(scenes, fraction, seed) if fraction else set()
    train, val = (
        [item for item, scene in zip(splits["train"], scenes, strict=True) if (scene in held) == of]
        for of in (False, True)
    )
    return {"train": train, "val": val, "test": splits["val"]}
