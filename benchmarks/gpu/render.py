"""Time and memory of rendering torch tensors, compared with reading the scores once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch

from benchmarks.labels import NUM_CLASSES, memory_table, random_scores
from benchmarks.measuring import DEVICE, Alternative, Goal, Table, attempted, measure, peak_mib
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.rendering import equirect_to_tangent, tangent_to_equirect, tangent_to_labels


def render(quick: bool) -> Iterator[Table]:
    """Render float32 scores at level 10."""
    level = 6 if quick else 10
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    scores, panorama = random_scores(grid).to(DEVICE), torch.randn(3, *shape, device=DEVICE)
    calls: dict[str, Callable[[], Any]] = {
        "tangent_to_labels": partial(tangent_to_labels, scores, grid, shape),
        "tangent_to_equirect": partial(tangent_to_equirect, scores, grid, shape),
        "equirect_to_tangent, RGB": partial(equirect_to_tangent, panorama, grid),
        "tangent_to_labels, feather": partial(tangent_to_labels, scores, grid, shape, "feather"),
    }
    rows = measure([Alternative("reading the scores once", scores.sum)], 5)
    peaks = {}
    for name, call in calls.items():
        with attempted(name):
            rows += measure([Alternative(name, call, is_ours=True)], 3 if "feather" in name else 5)
            peaks[name] = peak_mib(call)
    table = Table(f"render: time, level {level}, {NUM_CLASSES} classes", rows)
    table.goals = [Goal(f"{n}, of reading", table.ratio(n), 2) for n in list(calls)[:2]]
    yield table
    yield memory_table("render", scores, peaks)
