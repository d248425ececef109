"""Ways to do the same, measured in turn, and how they compare.

All ways of a table run one after the other, round after round, so that what else the machine does
meets all of them; what is compared is the quotient within each round. A machine's absolute figures
say little about another's: goals and the baseline are quotients.
"""

from __future__ import annotations

import math
import re
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tangent_train.cli.compose import config_folder

__all__ = [
    "Goal",
    "Interval",
    "Options",
    "Row",
    "Table",
    "Way",
    "at_least",
    "at_most",
    "composed",
    "in_process",
    "measure",
    "median_interval",
    "memory_kib",
    "peak_kib",
]

_SHORTEST_S = 0.02
"""What takes less is run so often that a measurement takes that long."""

_LONG_S = 1.0

_CONFIDENCE = 0.95


class Options(NamedTuple):
    """How thoroughly to measure.

    Attributes:
        quick: Small and few: enough to see it run, the figures mean nothing.
        rounds: Measurements of each way; None for each benchmark's own number.
    """

    quick: bool = False
    rounds: int | None = None

    def times(self, usual: int) -> int:
        """Measurements of each way where `usual` are enough."""
        return self.rounds or (2 if self.quick else usual)


class Way(NamedTuple):
    """One way to do it.

    Attributes:
        name: For people.
        run: Does it.
        ours: Whether it is this project's.
        scale: What the time of `run` is multiplied by, where it does only a part, or several.
        rounds: Fewer measurements, of ways that take long.
    """

    name: str
    run: Callable[[], object]
    ours: bool = False
    scale: float = 1.0
    rounds: int | None = None


@dataclass
class Row:
    """What was measured of one way.

    Attributes:
        name: For people.
        values: One of each round, in the unit of the table.
        ours: Whether it is this project's.
        size: What it grows with, in tables about growth.
    """

    name: str
    values: list[float]
    ours: bool = False
    size: float | None = None

    @property
    def median(self) -> float:
        """Of all rounds."""
        return statistics.median(self.values)


class Interval(NamedTuple):
    """A median, and between what it lies with 95 % confidence."""

    median: float
    low: float
    high: float


class Goal(NamedTuple):
    """Something promised.

    Attributes:
        what: For people.
        found: What was found.
        bound: What was promised.
        least: Whether `found` should be no less than the bound; else no more.
        unit: Behind both.
    """

    what: str
    found: float
    bound: float
    least: bool = False
    unit: str = ""

    @property
    def met(self) -> bool:
        """Whether the promise is kept."""
        return self.found >= self.bound if self.least else self.found <= self.bound


def at_most(what: str, found: float, bound: float, unit: str = "×") -> Goal:
    """A promise of no more than the bound."""
    return Goal(what, found, bound, False, unit)


def at_least(what: str, found: float, bound: float, unit: str = "×") -> Goal:
    """A promise of no less than the bound."""
    return Goal(what, found, bound, True, unit)


@dataclass
class Table:
    """Rows that are compared with the first of them.

    Attributes:
        name: Short and unique: the baseline knows it by this.
        title: For people.
        rows: The first is what all are compared with.
        unit: ``s`` or ``MiB``.
        goals: What was promised about it.
        notes: What people should know of it.
    """

    name: str
    title: str
    rows: list[Row]
    unit: str = "s"
    goals: list[Goal] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def row(self, name: str) -> Row:
        """The row of a name."""
        return next(row for row in self.rows if row.name == name)

    def ratio(self, name: str, to: str | None = None) -> Interval:
        """How a row compares with another, by default the first.

        Rows of as many rounds are compared round by round, others with the median.
        """
        ours, other = self.row(name), self.rows[0] if to is None else self.row(to)
        if len(ours.values) == len(other.values):
            pairs = zip(ours.values, other.values, strict=True)
            return median_interval([mine / its for mine, its in pairs])
        return median_interval([mine / other.median for mine in ours.values])


def median_interval(values: Sequence[float]) -> Interval:
    """The median of a sample, and between which of its values the true one lies.

    By the sign test: the true median is above a value with probability ½, whatever the
    distribution. Fewer than six values cannot tell with 95 %: then it is all of them.
    """
    ordered, count = sorted(values), len(values)
    outside = 0
    for rank in range(count // 2):
        tail = sum(math.comb(count, k) for k in range(rank + 1)) / 2**count
        if rank and 2 * tail > 1 - _CONFIDENCE:
            break
        outside = rank
    return Interval(statistics.median(ordered), ordered[outside], ordered[count - 1 - outside])


def measure(
    ways: Sequence[Way], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> list[Row]:
    """Seconds of all ways, run in turn; every other round in the opposite order.

    Args:
        ways: They; each is run before, which compiles and fills caches, again if that was short.
        rounds: Measurements of each that has no number of its own.
        clock: Seconds.
    """

    def seconds(way: Way, repeats: int) -> float:
        start = clock()
        for _ in range(repeats):
            way.run()
        return (clock() - start) / repeats

    first = [seconds(way, 1) for way in ways]
    second = [s if s > _LONG_S else seconds(w, 1) for w, s in zip(ways, first, strict=True)]
    repeats = [math.ceil(_SHORTEST_S / max(taken, 1e-6)) for taken in second]
    rows = [Row(way.name, [], way.ours) for way in ways]
    for turn in range(rounds):
        in_order = list(zip(ways, repeats, rows, strict=True))
        for way, count, row in in_order if turn % 2 == 0 else reversed(in_order):
            if turn < (way.rounds or rounds):
                row.values.append(seconds(way, count) * way.scale)
    return rows


def in_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call it in a new process, whose memory is its own."""
    context = get_context("forkserver")
    context.set_forkserver_preload([function.__module__])  # imports take longer than the call
    with ProcessPoolExecutor(1, context) as process:
        return process.submit(function, *arguments).result()


def peak_kib() -> int:
    """The peak of this process's memory so far, in KiB."""
    # Not getrusage: its peak is inherited from the process that started this one.
    return memory_kib("VmHWM")


def memory_kib(name: str, pid: int | str = "self") -> int:
    """A figure that Linux keeps of a process, in KiB.

    Args:
        name: As in ``/proc/<pid>/status`` and ``smaps_rollup``.
        pid: Which process.
    """
    process = Path(f"/proc/{pid}")
    text = (process / "status").read_text() + (process / "smaps_rollup").read_text()
    found = re.search(rf"^{name}:\s+(\d+) kB$", text, re.MULTILINE)
    if found is None:
        raise LookupError(f"/proc/{pid} says nothing about {name}")
    return int(found[1])


def composed(overrides: Sequence[str]) -> dict[str, Any]:
    """The settings of ``tangent-train`` with these overrides."""
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        settings: Any = OmegaConf.to_container(compose("train", list(overrides)), resolve=True)
    return settings
