"""Time and memory of rendering torch tensors, compared with reading the scores once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch

from benchmarks.labels import NUM_CLASSES, memory_table, random_scores
from benchmarks.measuring import (
    DEVICE,
    Alternative,
    Goal,
    Row,
    Table,
    attempted,
    measure,
    peak_mib,
)
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.rendering import (
    equirect_to_tangent,
    perspective,
    tangent_to_equirect,
    tangent_to_labels,
)


def render(quick: bool) -> Iterator[Table]:
    """Render float32 scores at level 10; views of a panorama beside pyequilib."""
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
    goals = {"tangent_to_labels": 4, "tangent_to_labels, feather": 10}
    table.goals = [Goal(f"{n}, of reading", table.ratio(n), most) for n, most in goals.items()]
    yield table
    yield memory_table("render", scores, peaks)
    yield Table("render: 16 views of 512² of a panorama", _views(2 if quick else 5, panorama))


def _views(rounds: int, panorama: torch.Tensor) -> list[Row]:
    """Time horizontal views; both libraries compute the positions anew for each call."""
    from equilib import Equi2Pers

    yaw = [360 * k / 16 for k in range(16)]
    view = Equi2Pers(height=512, width=512, fov_x=90.0)
    poses = [{"yaw": math.radians(angle), "pitch": 0.0, "roll": 0.0} for angle in yaw]
    batch = panorama.expand(16, -1, -1, -1)
    alternatives = [
        Alternative("pyequilib", lambda: view(batch, poses)),
        Alternative("perspective", lambda: perspective(panorama, yaw, size=512), is_ours=True),
    ]
    return measure(alternatives, rounds)
