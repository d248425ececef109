"""Index of the items of a data set: finds broken items, reads items from files or a store."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from datamodules.core.problems import Problems
from datamodules.core.store import Store
from tangent_train.errors import DataError, SettingError
from tangent_train.progress import show_progress
from tangent_train.threads import in_threads

Split = Literal["train", "val", "test"]
"""A split of a data set."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
"""All splits, in order."""

SAMPLED = 32
"""Maximum number of images that `DatasetIndex.read_some` decodes."""

_SECONDS = 2.0


class Item(Protocol):
    """The source of one image or shape."""

    @property
    def name(self) -> str:
        """Unique short name."""
        ...

    @property
    def parts(self) -> Mapping[str, Path]:
        """Files of the item by content."""
        ...


_Item = TypeVar("_Item", bound=Item)
_Reads = Mapping[str, Callable[[Any], object]]
"""Functions that read a part of an item, by part."""

_WHOLE = "whole item"


@dataclass(frozen=True)
class DatasetIndex(Generic[_Item]):
    """The images or shapes of a data set.

    Attributes:
        noun: Name of the items, in the plural.
        splits: Files of the images or shapes of each split.
        read: Function that reads an item from its files; may have methods `labels` and `parts`
            (functions that decode the files of one part).
        kind: Named tuple of arrays that `read` returns.
        store: Prepared store, if any.
        in_parallel: Function that applies a function to each item and yields results as they come.

    Raises:
        SettingError: The splits have other names.
    """

    noun: str
    splits: Mapping[Split, Sequence[_Item]]
    read: Callable[[_Item], Any]
    kind: type[Any]
    store: Store | None = None
    in_parallel: Callable[[Callable[[_Item], Any], Sequence[_Item]], Generator[Any]] = in_threads

    def __post_init__(self) -> None:
        if set(self.splits) != set(SPLITS):
            expected = f"{', '.join(SPLITS)}; a split may be empty"
            raise SettingError("splits", found=", ".join(self.splits), expected=expected)

    def of(self, splits: Sequence[Split] = SPLITS) -> list[_Item]:
        """Return the items of the given splits."""
        return [item for split in splits for item in self.splits[split]]

    def check(self, problems: Problems, label_counts: dict[str, NDArray[np.int64]]) -> None:
        """Decode every file separately and note broken ones; write nothing.

        Args:
            problems: Known problems; collects new problems and warnings.
            label_counts: Collects the number of pixels of each label by image; unused for shapes.
        """
        items = problems.without(self.of())
        read: Any = self.read
        parts = hasattr(read, "parts")
        reads = read.parts(label_counts, problems.warnings) if parts else {_WHOLE: read}
        self._note(problems, reads, items, "Checking")

    def read_all(self, items: Sequence[_Item], problems: Problems, *, whole: bool) -> None:
        """Read items once, into the store if there is one; note broken items.

        Args:
            items: Items of the index.
            problems: Known problems; new ones are added.
            whole: True to check the content of the store now, not when samples first use it.
        """
        items, store = problems.without(items), self.store
        if store is None:
            self._note(problems, {_WHOLE: self.read}, items, "Checking the data")
            return
        is_current = partial(store.is_current, whole=whole)
        missing = [item for item in items if not is_current(item.name, item.parts)]
        if missing:
            before = len(items) - len(missing)
            make = {_WHOLE: partial(_store_item, self.read, store)}
            self._note(problems, make, missing, f"Preparing {self.noun}", before)

    def read_some(self, seed: int, problems: Problems) -> None:
        """Decode a random sample of images, for a second or two; note broken images.

        Args:
            seed: Seed of the choice.
            problems: Known problems; new ones are added.
        """
        items = problems.without(self.of())
        rng = np.random.default_rng(seed)
        strata = np.array_split(np.arange(len(items)), min(SAMPLED, len(items)) or 1)
        chosen = rng.permutation([rng.choice(stratum) for stratum in strata if len(stratum)])
        until = time.monotonic() + _SECONDS
        for _ in self._read(problems, {_WHOLE: self.read}, [items[place] for place in chosen]):
            if time.monotonic() > until:
                return

    def without(self, problems: Problems) -> DatasetIndex[_Item]:
        """Return a copy of the index without broken items."""
        splits = {split: problems.without(items) for split, items in self.splits.items()}
        return replace(self, splits=splits)

    def _note(
        self, problems: Problems, reads: _Reads, items: Sequence[_Item], what: str, before: int = 0
    ) -> None:
        """Read items in parallel, note broken items, and show progress."""
        with closing(self._read(problems, reads, items)) as done:
            show_progress(done, what, self.noun, before + len(items), before)

    def _read(self, problems: Problems, reads: _Reads, items: Sequence[_Item]) -> Generator[None]:
        """Read items in parallel and note broken items; yield after each."""
        with closing(self.in_parallel(partial(_errors, reads), items)) as results:
            for item, errors in results:
                for error in errors:
                    with problems.noted(item.name, next(iter(item.parts.values()))):
                        raise error
                yield


def _errors(reads: _Reads, item: Item) -> tuple[Item, list[Exception]]:
    """Return the errors of reading one item; runs in worker processes too."""
    errors: list[Exception] = []
    for part, read in reads.items():
        if part == _WHOLE or part in item.parts:
            try:
                read(item)
            except (DataError, SettingError, OSError) as error:
                errors.append(error)
    return item, errors


def _store_item(read: Callable[[Any], Any], store: Store, item: Item) -> None:
    store.make(item.name, item.parts, partial(_arrays, read, item))


def _arrays(read: Callable[[Any], Any], item: Item) -> dict[str, Any]:
    """Return the arrays of a named tuple that are not None."""
    return {name: array for name, array in read(item)._asdict().items() if array is not None}


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
    splits: Mapping[Split, Sequence[_Item]],
    test_split: Literal["test", "val"],
    fraction: float,
    seed: int,
) -> dict[Split, Sequence[_Item]]:
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
