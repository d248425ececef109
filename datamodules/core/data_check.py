"""Looking at a data set before a run: at all of it, or at some of it as training begins."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from lightning.pytorch.utilities import rank_zero_only
from rich.console import Console

from datamodules.core.problems import Problems
from datamodules.core.progress import show_progress
from datamodules.core.sources import in_threads, read_strictly
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from datamodules.core.split_module import Split, SplitDataModule

__all__ = ["SAMPLED", "check_all", "find_usable", "read_parts", "unreadable"]

SAMPLED = 32
"""How many images are read as training begins, at most."""

_SECONDS = 2.0
_GO_ON = (
    "tangent-check with the same data settings lists all there are; data.skip_broken=true goes on "
    "without what is broken."
)


def find_usable(data: SplitDataModule[Any], sampled: Sequence[Split] = ()) -> Mapping[Split, Any]:
    """What every split of a data set has, checked; without what is broken, if that is asked for.

    Args:
        data: The data set.
        sampled: Splits of which some images are read, for a second or two.

    Raises:
        DataError: Something is broken and not to be left out, or a split has nothing left.
        SettingError: A setting does not suit the data.
    """
    data.problems = problems = Problems()
    splits: Mapping[Split, Any] = {}
    with problems.noted():
        splits = data.find_splits()
    listed = splits
    if data.skip_broken and not problems.fatal:
        splits = data.readable(splits)
    elif splits and sampled:
        _sample({split: splits[split] for split in sampled}, problems, data.seed)
    left = sum(map(len, splits.values()))
    if problems.fatal or not data.skip_broken:
        problems.refuse(data.root, left=left, more="" if problems.fatal else _GO_ON)
    if problems.items:
        _check_left(data, [s for s in splits if s != "val" or len(listed[s])], splits)
        _tell(data, len(problems.items), left)
    return splits


def _check_left(
    data: SplitDataModule[Any], needed: Sequence[Split], splits: Mapping[Split, Any]
) -> None:
    empty = [split for split in needed if not len(splits[split])]
    if empty:
        raise DataError(
            data.root,
            found=f"no {data.noun} for {empty[0]} that can be used",
            expected="one or more",
            remedy="tangent-check lists what is wrong with them.",
        )


@rank_zero_only
def _tell(data: SplitDataModule[Any], broken: int, left: int) -> None:
    text = (
        f"{broken} of {broken + left} {data.noun} are broken and left out (data.skip_broken=true); "
        "tangent-check lists them."
    )
    Console(soft_wrap=True, highlight=False).print(text, markup=False)


def unreadable(
    splits: Mapping[Split, Any],
    read: Callable[[Any, int], object],
    problems: Problems,
    noun: str,
) -> set[tuple[Split, int]]:
    """Read all images, each as a whole; what cannot be is noted.

    Args:
        splits: Sources.
        read: Reads an image of one of them.
        problems: Where it is noted.
        noun: What they are, in the plural.

    Returns:
        Split and number of what is broken.
    """
    places = _places(splits)

    def check(place: int) -> None:
        split, index = places[place]
        with problems.noted(places[place]):
            read(splits[split], index)

    show_progress(in_threads(check, len(places)), "Checking the data", noun, len(places))
    broken = problems.items
    return {place for place in places if place in broken}


def _sample(splits: Mapping[Split, Any], problems: Problems, seed: int) -> None:
    """Read some images of several splits, and note what is broken."""
    places = _spread(_places(splits), seed)

    def check(place: int) -> None:
        split, index = places[place]
        with problems.noted(places[place]):
            read_strictly(splits[split], index)

    until = time.monotonic() + _SECONDS
    for _ in in_threads(check, len(places)):
        if time.monotonic() > until:
            break


def _spread(places: Sequence[tuple[Split, int]], seed: int) -> list[tuple[Split, int]]:
    """A few places from all over the data set in random order, other ones for other seeds."""
    rng = np.random.default_rng(seed)
    strata = np.array_split(np.arange(len(places)), min(SAMPLED, len(places)) or 1)
    chosen = [int(rng.choice(stratum)) for stratum in strata if len(stratum)]
    return [places[place] for place in rng.permutation(chosen)]


def check_all(data: SplitDataModule[Any], *, progress: bool = True) -> tuple[Problems, int]:
    """Read all of a data set; nothing is made or written.

    Args:
        data: The data set.
        progress: Whether to show a progress bar.

    Returns:
        All that is wrong, and how many images or shapes were read.
    """
    data.problems = problems = Problems()
    splits: Mapping[Split, Any] = {}
    count = 0
    with problems.noted():
        if data.is_made and not data.root.is_dir():
            raise DataError(
                data.root,
                found="no such folder",
                expected="the data set",
                remedy="Run tangent-prepare with the same settings: it makes it.",
            )
        splits = data.find_splits()
    with problems.noted():
        count, reading = data.content(splits)
        show_progress(reading, "Checking", data.noun, count, show=progress)
    return problems, count


def read_parts(splits: Mapping[Split, Any], problems: Problems) -> tuple[int, Iterator[None]]:
    """Read the files of all images one by one, to find all that are broken.

    Returns:
        How many images there are, and what yields whenever one has been read.
    """
    places = _places(splits)

    def check(place: int) -> None:
        split, index = places[place]
        for read in splits[split].readers(index):
            with problems.noted(places[place]):
                read()

    return len(places), in_threads(check, len(places))


def _places(splits: Mapping[Split, Any]) -> list[tuple[Split, int]]:
    return [(split, index) for split, source in splits.items() for index in range(len(source))]
