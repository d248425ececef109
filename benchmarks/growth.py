"""Time and memory as panoramas and the number of images grow: linear in pixels.

Base levels do not change how many pixels there are, 20·4^s in all images of level s.
"""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.labels import random_scores
from benchmarks.measuring import (
    Options,
    Row,
    Table,
    Way,
    at_most,
    in_process,
    measure,
    memory_kib,
    peak_kib,
)
from benchmarks.report import amount
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.rendering import (
    equirect_to_tangent,
    set_table_cache_limit,
    tangent_to_labels,
)
from tangent_train.rendering.tables import TABLES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

__all__ = ["exponent", "tables"]

NUM_CLASSES = 4
TO_IMAGES = "to images"
TO_LABELS = "to labels"

_ROOM = 2**31
_BYTES_PER_PIXEL = 8
"""Of the tables from panoramas to images."""
_CONSTANT = 1.5
_LINEAR = 1.15


def tables(options: Options) -> Iterator[Table]:
    """Time and memory over levels and base levels."""
    levels = (5, 6, 7) if options.quick else (7, 8, 9, 10, 11)
    common = 6 if options.quick else 10
    over_levels = [TangentGrid(1, level) for level in levels]
    over_bases = [TangentGrid(base_level, common) for base_level in range(4)]
    for what in (TO_IMAGES, TO_LABELS):
        for grids in (over_levels, over_bases):
            yield _times(what, grids, options)
            yield _memory(what, grids)


def _name(grid: TangentGrid) -> str:
    return f"level {grid.level}, b = {grid.base_level}"


def _over(grids: Sequence[TangentGrid]) -> str:
    return "levels" if grids[0].level != grids[-1].level else "base levels"


def _work(what: str, grid: TangentGrid) -> Callable[[], object]:
    """Rendering made-up pixels, held by what is returned."""
    shape = equirect_shape(grid.level)
    if what == TO_IMAGES:
        panorama = np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)
        return partial(equirect_to_tangent, panorama, grid)
    return partial(tangent_to_labels, random_scores(grid, NUM_CLASSES), grid, shape)


def _times(what: str, grids: Sequence[TangentGrid], options: Options) -> Table:
    """With room for all tables: those of level 11 need more than there is by default."""
    ways = [Way(_name(grid), _work(what, grid), ours=True) for grid in grids]
    room = TABLES.limit
    set_table_cache_limit(_ROOM)
    rows = measure(ways, options.times(5))
    set_table_cache_limit(room)
    table = _finished(what, grids, rows, "time", "s")
    largest = grids[-1]
    if what == TO_IMAGES and _BYTES_PER_PIXEL * largest.num_images * largest.dim**2 > room:
        start = time.perf_counter()
        ways[-1].run()
        again = amount(time.perf_counter() - start, "s")
        table.notes = [
            f"{_name(largest)} with set_table_cache_limit({_ROOM}): by default its tables are made "
            f"anew each time, {again}"
        ]
    return table


def _memory(what: str, grids: Sequence[TangentGrid]) -> Table:
    rows = [
        Row(_name(grid), [in_process(_mebibytes, what, grid.base_level, grid.level)], ours=True)
        for grid in grids
    ]
    return _finished(what, grids, rows, "memory", "MiB")


def _mebibytes(what: str, base_level: int, level: int) -> float:
    """Input, tables and result of a process of its own, the code compiled before."""
    _work(what, TangentGrid(0, 5))()
    before = memory_kib("VmRSS")
    result = _work(what, TangentGrid(base_level, level))()
    added = peak_kib() - before
    del result
    return max(1, added) / 2**10


def _finished(
    what: str, grids: Sequence[TangentGrid], rows: list[Row], measured: str, unit: str
) -> Table:
    pixels = [grid.num_images * grid.dim**2 for grid in grids]
    kind = "RGB uint8 " if what == TO_IMAGES else f"{NUM_CLASSES} scores "
    title = f"{measured.capitalize()} over {_over(grids)}: {kind}{what}"
    table = Table(f"growth: {measured} {what} over {_over(grids)}", title, rows, unit)
    if len(set(pixels)) > 1:
        for row, size in zip(rows, pixels, strict=True):
            row.size = float(size)
        table.goals = [at_most("grows with pixels to the power", exponent(rows), _LINEAR, "")]
    else:
        medians = [row.median for row in rows]
        table.goals = [at_most("most of least", max(medians) / min(medians), _CONSTANT)]
    return table


def exponent(rows: Sequence[Row]) -> float:
    """The slope of a line through the logarithms of sizes and medians."""
    sizes, medians = np.log([[row.size or 1.0, row.median] for row in rows]).T
    return float(np.polyfit(sizes, medians, 1)[0])
