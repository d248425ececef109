"""Time rendering of labels, compared with `grid_sample` and `argmax`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np
import torch
from torch.nn import functional

from benchmarks.measuring import Alternative, Goal, Row, Table, expect_agreement, measure, peak_mib
from tangent_train.geometry import TangentGrid, equirect_directions, equirect_shape
from tangent_train.rendering import tangent_to_labels

NUM_CLASSES = 13
PLAIN = "grid_sample of a mosaic, argmax"
OURS = "tangent_to_labels"


def labels(quick: bool) -> Iterator[Table]:
    """Yield tables of time and memory."""
    level = 6 if quick else 10
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    small, scores = TangentGrid(1, 5), random_scores(grid)
    tangent_to_labels(random_scores(small), small, equirect_shape(5))  # compiles
    array = scores.numpy()
    peak = peak_mib(lambda: tangent_to_labels(array, grid, shape), torch.device("cpu"))
    plain = _plain(scores, grid, shape)
    is_same = plain().numpy() == tangent_to_labels(array, grid, shape)
    expect_agreement(PLAIN, float(is_same.mean()), 0.995)
    noise = random_scores(grid, apart=1).numpy()
    alternatives = [
        Alternative(PLAIN, plain),
        Alternative(OURS, lambda: tangent_to_labels(array, grid, shape), is_ours=True),
        Alternative(
            f"{OURS}, white noise", lambda: tangent_to_labels(noise, grid, shape), True, rounds=3
        ),
        Alternative(
            f"{OURS}, feather", lambda: tangent_to_labels(array, grid, shape, "feather"), True
        ),
    ]
    table = Table("labels: time", measure(alternatives, 2 if quick else 7))
    table.goals = [Goal("as fast as grid_sample", 1 / table.ratio(OURS), 15, True)]
    yield table
    yield memory_table("labels", scores, {OURS: peak})


def random_scores(grid: TangentGrid, apart: int = 32) -> torch.Tensor:
    """Return float32 scores of all images: normal numbers some pixels apart, interpolated."""
    side = max(2, grid.dim // apart)
    size = (grid.num_images, NUM_CLASSES, side, side)
    scores = torch.randn(size, generator=torch.Generator().manual_seed(0))
    return functional.interpolate(scores, (grid.dim, grid.dim), mode="bilinear")


def _plain(
    scores: torch.Tensor, grid: TangentGrid, shape: tuple[int, int]
) -> Callable[[], torch.Tensor]:
    """Return a function for labels from the owners' bilinear scores, with precomputed positions."""
    mosaic = scores.movedim(0, 1).reshape(1, NUM_CLASSES, -1, grid.dim)
    directions, positions = equirect_directions(shape), np.empty((*shape, 2), np.float32)
    for row in range(shape[0]):  # all at once takes gigabytes
        owners = grid.owners(directions[row])
        u, v = grid.project(directions[row], owners).T
        scaled = u / (grid.dim - 1), (owners * grid.dim + v) / (mosaic.shape[2] - 1)
        positions[row] = np.stack(scaled, axis=-1) * 2 - 1
    points = torch.from_numpy(positions)[None]
    sample = partial(functional.grid_sample, padding_mode="border", align_corners=True)
    return lambda: sample(mosaic, points)[0].argmax(dim=0)


def memory_table(name: str, scores: torch.Tensor, added_mib: Mapping[str, float]) -> Table:
    """Return a table of the peak memory of renderers, including the scores.

    Args:
        name: Name of the benchmark.
        scores: Scores that were rendered.
        added_mib: Memory added by each renderer, see `peak_mib`.
    """
    given = scores.nbytes / 2**20
    rows = [Row(renderer, [given + added], is_ours=True) for renderer, added in added_mib.items()]
    table = Table(f"{name}: memory, scores included", [Row("the scores", [given]), *rows], "MiB")
    table.goals = [Goal(f"{n}, of the scores' memory", table.ratio(n), 1.3) for n in added_mib]
    return table
