"""Work on many files with a progress bar; an error in one file does not stop the others."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from tangent_train.errors import DataError, SettingError, printable
from tangent_train.progress import progress_bar
from tangent_train.threads import in_threads

_THREADS = min(4, os.cpu_count() or 1)
"""Largest number of images that are read ahead, and that wait to be written, in memory."""


@dataclass(frozen=True)
class Job:
    """Work on one item.

    Attributes:
        item: Name of the item.
        path: File that the item comes from.
        value: Input of the next step; after the last step, the result.
        error: Message of a failed step; empty if all succeeded.
    """

    item: Any
    path: Path
    value: Any = None
    error: str = ""

    def then(self, step: Callable[[Job], Any]) -> Job:
        """Return the job after its next step; after an error, the step is skipped."""
        if self.error:
            return self
        try:
            return replace(self, value=step(self))
        except (DataError, SettingError, MemoryError) as error:
            message = str(error) if str(self.path) in str(error) else f"{self.path}: {error}"
            return replace(self, value=None, error=message)


def run_jobs(
    description: str,
    jobs: Iterable[Job],
    count: int,
    work: Callable[[Job, Callable[[float], object]], Any],
    before: Callable[[Job], Any] | None = None,
    after: Callable[[Job], Any] | None = None,
) -> Generator[Job]:
    """Work on items, showing a progress bar with the rate and the time left.

    Args:
        description: Label of the progress bar.
        jobs: Jobs of the items.
        count: Number of jobs.
        work: Function that does the work in this thread, one item at a time. It takes a job, and a
            function to call with the share of the work done since the last call.
        before: Step that other threads do ahead of the work.
        after: Step that other threads do after the work.

    Yields:
        Finished jobs in order; their errors have been printed.
    """
    with progress_bar() as bar:
        task = bar.add_task(description, total=count, unit="", before=0, rate="")
        progress = partial(bar.advance, task)

        def worked() -> Iterator[Job]:
            for number, job in enumerate(_stage(before, jobs), start=1):
                yield job.then(lambda job: work(job, progress))
                bar.update(task, completed=number)

        for job in _stage(after, worked()):
            if job.error:
                bar.console.print(printable(job.error), style="red", markup=False, soft_wrap=True)
            yield job


def _stage(step: Callable[[Job], Any] | None, jobs: Iterable[Job]) -> Iterable[Job]:
    if step is None:
        return jobs
    return in_threads(lambda job: job.then(step), jobs, _THREADS, _THREADS)


_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Shard:
    """One of several parts of a list, whose lengths differ by at most one item.

    Attributes:
        number: Number of the part, from 1 to `count`.
        count: Number of parts.
    """

    number: int
    count: int

    @classmethod
    def parse(cls, setting: Any) -> Shard | None:
        """Return the part that a setting names; None for null.

        Args:
            setting: Value of ``shard``, e.g. ``3/16``, or None.

        Raises:
            SettingError: The setting does not name a part.

        >>> Shard.parse("3/16")
        Shard(number=3, count=16)
        """
        if setting is None:
            return None
        match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", str(setting), re.ASCII)
        number, count = map(int, match.groups()) if match else (0, 0)
        if not 1 <= number <= count:
            expected = "number/count, such as 1/16 to 16/16, or null"
            raise SettingError("shard", found=setting, expected=expected)
        return cls(number, count)

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def part(self, items: Sequence[_Item]) -> list[_Item]:
        """Return the items of a list that belong to the part: every `count`-th.

        >>> Shard(2, 3).part("abcdefg")
        ['b', 'e']
        """
        return list(items[self.number - 1 :: self.count])
