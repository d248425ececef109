"""Measure alternatives in turn.

All alternatives of a table run one after the other in each round, so that background load affects
all of them. The result is the ratio to the first alternative within each round, because absolute
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
from typing import Any, NamedTuple

import numpy as np
import torch

from datamodules.core.inputs import RGB_NORMALIZATION
from models import UNet
from tangent_train.checkpoints.loaded import LoadedNetwork

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
"""Device of the GPU benchmarks."""

ON_GPU = DEVICE.type == "cuda"

FAILURES: list[str] = []
"""Failed benchmarks with their errors."""

_SHORTEST_S = 0.02
"""Shorter calls are repeated until they take that long."""


class Alternative(NamedTuple):
    """An implementation that is measured.

    Attributes:
        name: Name of the row.
        run: Runs the implementation once.
        is_ours: True for an implementation of this project.
        scale: Factor for its time, if it does a part or a multiple of the work.
        rounds: Largest number of rounds, for slow alternatives.
    """

    name: str
    run: Callable[[], object]
    is_ours: bool = False
    scale: float = 1.0
    rounds: int = 1000


@dataclass
class Row:
    """Measurements of an alternative: a value for each round, in the unit of the table."""

    name: str
    values: list[float]
    is_ours: bool = False

    @property
    def median(self) -> float:
        """Median of all rounds."""
        return statistics.median(self.values)


class Goal(NamedTuple):
    """A goal for a figure: at most the bound, or at least the bound if `least` is set."""

    what: str
    found: float
    bound: float
    least: bool = False

    @property
    def met(self) -> bool:
        """True if the figure meets the bound."""
        return self.found >= self.bound if self.least else self.found <= self.bound


@dataclass
class Table:
    """Rows that are compared with the first row.

    Attributes:
        name: Short, unique name, used in the baseline.
        rows: Measurements.
        unit: Unit of the values, such as ``s`` or ``MiB``.
        goals: Goals for figures of the table.
    """

    name: str
    rows: list[Row]
    unit: str = "s"
    goals: list[Goal] = field(default_factory=list)

    def ratios(self, name: str, to: str | None = None) -> list[float]:
        """Divide a row by another, by default the first; round by round if their numbers agree."""
        rows = {row.name: row for row in self.rows}
        row, other = rows[name], self.rows[0] if to is None else rows[to]
        if len(row.values) == len(other.values):
            return [a / b for a, b in zip(row.values, other.values, strict=True)]
        return [a / other.median for a in row.values]

    def ratio(self, name: str, to: str | None = None) -> float:
        """Return the median of `ratios`."""
        return statistics.median(self.ratios(name, to))


def measure(alternatives: Sequence[Alternative], rounds: int) -> list[Row]:
    """Measure the seconds of alternatives, in turn; every other round in the opposite order.

    Args:
        alternatives: Each runs twice first, to compile code and fill caches.
        rounds: Number of measurements of each.
    """

    def seconds(alternative: Alternative, repeats: int) -> float:
        start = time.perf_counter()
        for _ in range(repeats):
            alternative.run()
        if DEVICE.type == "cuda":
            torch.cuda.synchronize()
        return (time.perf_counter() - start) / repeats

    warm = [min(seconds(alternative, 1), seconds(alternative, 1)) for alternative in alternatives]
    repeats = [math.ceil(_SHORTEST_S / max(taken, 1e-6)) for taken in warm]
    rows = [Row(alternative.name, [], alternative.is_ours) for alternative in alternatives]
    for number in range(rounds):
        for k in range(len(alternatives))[:: -1 if number % 2 else 1]:
            if number < alternatives[k].rounds:
                rows[k].values.append(seconds(alternatives[k], repeats[k]) * alternatives[k].scale)
    return rows


def tangent_network(level: int, widths: Sequence[int]) -> LoadedNetwork:
    """Return an untrained UNet of 13 classes for tangent images of b = 0."""
    torch.manual_seed(0)
    settings: dict[str, Any] = {"in_channels": 3, "num_classes": 13, "widths": widths}
    target = "tangent_train.rendering.TangentRepresentation"
    return LoadedNetwork(
        module=UNet(**settings).eval(),
        class_names=("unknown", *map(str, range(13))),
        inputs=("rgb",),
        normalization=RGB_NORMALIZATION,
        level=level,
        representation={"_target_": target, "base_level": 0, "level": level},
        image_size=(2**level, 2**level),
        size_multiple=2 ** (len(widths) - 1),
        settings={"_target_": "models.UNet", **settings},
    )


def expect_agreement(name: str, share: float, least: float) -> None:
    """Refuse a comparison of different results.

    Args:
        name: Name of the alternative.
        share: Share of its results that agree with this project's.
        least: Least share of a fair comparison.

    Raises:
        RuntimeError: The share is smaller.
    """
    if not share >= least:
        raise RuntimeError(f"{name}: {share:.2%} of the results agree; expected {least:.2%}")


def peak_mib(call: Callable[[], object], device: torch.device = DEVICE) -> float:
    """Return the peak memory in MiB that a call adds on a device; for the CPU, in this process."""
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
    """Return this process's current memory (``VmRSS``) or peak memory (``VmHWM``) in KiB."""
    status = Path("/proc/self/status").read_text()
    return int(re.findall(rf"^{name}:\s+(\d+) kB$", status, re.MULTILINE)[0])


@contextmanager
def attempted(name: str) -> Iterator[None]:
    """Record an error in `FAILURES` instead of raising it, and free memory."""
    try:
        yield
    except Exception as error:
        traceback.print_exc()
        FAILURES.append(f"{name}: {type(error).__name__}: {error}")
    finally:
        gc.collect()
        torch.cuda.empty_cache()


def busy_s(profiler: Any) -> float:
    """Return the seconds in which at least one kernel or copy ran."""
    events = [e for e in profiler.events() if e.device_type.name.lower() == DEVICE.type]
    events = [event for event in events if not getattr(event, "is_user_annotation", False)]
    start, end = np.array(sorted((e.time_range.start, e.time_range.end) for e in events)).T
    until = np.maximum.accumulate(np.append(0, end[:-1]))
    return float(np.maximum(0, end - np.maximum(start, until)).sum()) / 1e6
