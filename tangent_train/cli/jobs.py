"""Work on many files: a progress bar, and errors that do not stop the others."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from datamodules.core.progress import progress_bar
from tangent_train.errors import DataError, SettingError, printable
from tangent_train.threads import in_threads

_THREADS = min(4, os.cpu_count() or 1)
"""Images that are read ahead, and that are written meanwhile, at most: all are in memory."""


@dataclass(frozen=True)
class Job:
    """Work on one item.

    Attributes:
        item: Name of the item.
        path: The file that it is from.
        value: Input of the next step; finally the result.
        error: Message if there is no result.
    """

    item: Any
    path: Path
    value: Any = None
    error: str = ""

    def then(self, step: Callable[[Job], Any]) -> Job:
        """The job after its next step, which is left out after an error."""
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
    """Do some work for every item, with its rate and the time left on a bar.

    Args:
        description: Label of the progress bar.
        jobs: The items.
        count: How many there are.
        work: Done here, one by one. Takes a job, and a function to call with the share of the work
            done since the last call.
        before: Done in other threads for the next items.
        after: Done in other threads for the last items.

    Yields:
        Finished jobs in order; errors have been printed.
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
    """One of several parts of a list, which differ in length by one item at most.

    Attributes:
        number: 1 to `count`.
        count: Number of parts.
    """

    number: int
    count: int

    @classmethod
    def of(cls, setting: Any) -> Shard | None:
        """The part that a setting names; without one, there are no parts.

        Args:
            setting: As ``3/16``, or None.

        Raises:
            SettingError: There is no such part.

        >>> Shard.of("3/16")
        Shard(number=3, count=16)
        """
        if setting is None:
            return None
        named = re.fullmatch(r"(\d{1,9})/(\d{1,9})", str(setting), re.ASCII)
        number, count = map(int, named.groups()) if named else (0, 0)
        if not 1 <= number <= count:
            raise SettingError("shard", found=setting, expected="1/16 to 16/16, or of others; null")
        return cls(number, count)

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def part(self, items: Sequence[_Item]) -> list[_Item]:
        """Its items of a list: every `count`-th.

        >>> Shard(2, 3).part("abcdefg")
        ['b', 'e']
        """
        return list(items[self.number - 1 :: self.count])
