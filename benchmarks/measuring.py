"""Alternatives measured in turn.

All alternatives of a table run one after the other, round after round, so that background load
affects all of them; the result is the ratio to the first alternative within each round. Absolute
times do not transfer to another machine.
"""

from __future__ import annotations

import gc
import math
import re
import statistics
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import torch

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
"""Of the measurements that are meant for a GPU."""

FAILURES: list[str] = []
"""What was attempted and failed, and why."""

_SHORTEST_S = 0.02
"""Shorter calls are repeated until they take that long."""


class Way(NamedTuple):
    """One way to do it.

    Attributes:
        name: For people.
        run: Does it.
        ours: Whether it is this project's.
        scale: Factor for its time, if it does only a part of the work, or several times as much.
        rounds: Most rounds, of ways that take long.
    """

    name: str
    run: Callable[[], object]
    ours: bool = False
    scale: float = 1.0
    rounds: int = 1000


@dataclass
class Row:
    """Measurements of one way, a value per round in the unit of the table."""

    name: str
    values: list[float]
    ours: bool = False

    @property
    def median(self) -> float:
        """Of all rounds."""
        return statistics.median(self.values)


class Goal(NamedTuple):
    """A promise: what was found should be at most the bound, or at least it."""

    what: str
    found: float
    bound: float
    least: bool = False

    @property
    def met(self) -> bool:
        """Whether the promise is kept."""
        return self.found >= self.bound if self.least else self.found <= self.bound


@dataclass
class Table:
    """Rows that are compared with the first of them.

    Attributes:
        name: Short and unique: the baseline knows it by this.
        rows: Measurements.
        unit: Such as ``s`` or ``MiB``.
        goals: Its promises.
    """

    name: str
    rows: list[Row]
    unit: str = "s"
    goals: list[Goal] = field(default_factory=list)

    def ratios(self, name: str, to: str | None = None) -> list[float]:
        """A row over another, by default the first: round by round where there are as many."""
        rows = {row.name: row for row in self.rows}
        row, other = rows[name], self.rows[0] if to is None else rows[to]
        if len(row.values) == len(other.values):
            return [a / b for a, b in zip(row.values, other.values, strict=True)]
        return [a / other.median for a in row.values]

    def ratio(self, name: str, to: str | None = None) -> float:
        """The median of `ratios`."""
        return statistics.median(self.ratios(name, to))


def measure(ways: Sequence[Way], rounds: int) -> list[Row]:
    """Seconds of all alternatives, run in turn, every other round in the opposite order.

    Args:
        ways: Each is run twice before, which compiles and fills caches.
        rounds: Measurements of each.
    """

    def seconds(way: Way, repeats: int) -> float:
        start = time.perf_counter()
        for _ in range(repeats):
            way.run()
        if DEVICE.type == "cuda":
            torch.cuda.synchronize()
        return (time.perf_counter() - start) / repeats

    warm = [min(seconds(way, 1), seconds(way, 1)) for way in ways]
    repeats = [math.ceil(_SHORTEST_S / max(taken, 1e-6)) for taken in warm]
    rows = [Row(way.name, [], way.ours) for way in ways]
    for number in range(rounds):
        for k in range(len(ways))[:: -1 if number % 2 else 1]:
            if number < ways[k].rounds:
                rows[k].values.append(seconds(ways[k], repeats[k]) * ways[k].scale)
    return rows


def peak_mib(call: Callable[[], object], device: torch.device = DEVICE) -> float:
    """Memory of a device that a call adds at most, in MiB; of the CPU, of this process."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        call()
        return (torch.cuda.max_memory_allocated() - before) / 2**20
    Path("/proc/self/clear_refs").write_text("5")  # VmHWM begins anew
    before = _memory_kib("VmRSS")
    call()
    return max(1, _memory_kib("VmHWM") - before) / 2**10


def _memory_kib(name: str) -> int:
    """A figure of this process: ``VmRSS`` is what it holds, ``VmHWM`` what it held at most."""
    status = Path("/proc/self/status").read_text()
    return int(re.findall(rf"^{name}:\s+(\d+) kB$", status, re.MULTILINE)[0])


@contextmanager
def attempted(name: str) -> Iterator[None]:
    """What fails in here is listed, and what comes after it goes on."""
    try:
        yield
    except Exception as error:
        traceback.print_exc()
        FAILURES.append(f"{name}: {type(error).__name__}: {error}")
    finally:
        gc.collect()
        torch.cuda.empty_cache()
