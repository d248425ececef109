"""Rendering labels, compared with `grid_sample` and `argmax`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np
import torch
from torch.nn import functional

from benchmarks.measuring import Goal, Row, Table, Way, measure, peak_mib
from tangent_train.geometry import TangentGrid, equirect_directions, equirect_shape
from tangent_train.rendering import tangent_to_labels

NUM_CLASSES = 13
PLAIN = "grid_sample of a mosaic, argmax"
OURS = "tangent_to_labels"


def labels(quick: bool) -> Iterator[Table]:
    """Time and memory."""
    level = 6 if quick else 10
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    small, scores = TangentGrid(1, 5), random_scores(grid)
    tangent_to_labels(random_scores(small), small, equirect_shape(5))  # compiles
    array = scores.numpy()
    peak = peak_mib(lambda: tangent_to_labels(array, grid, shape), torch.device("cpu"))
    plain = _plain(scores, grid, shape)
    agree = np.mean(plain().numpy() == tangent_to_labels(array, grid, shape))
    if agree < 0.995:
        raise RuntimeError(f"{PLAIN} gives other labels: {agree:.1%} agree")

    noise = random_scores(grid, apart=1).numpy()
    ways = [
        Way(PLAIN, plain),
        Way(OURS, lambda: tangent_to_labels(array, grid, shape), ours=True),
        Way(f"{OURS}, white noise", lambda: tangent_to_labels(noise, grid, shape), True, rounds=3),
        Way(f"{OURS}, feather", lambda: tangent_to_labels(array, grid, shape, "feather"), True),
    ]
    table = Table("labels: time", measure(ways, 2 if quick else 7))
    table.goals = [Goal("as fast as grid_sample", 1 / table.ratio(OURS), 15, True)]
    yield table
    yield memory_table("labels", scores, {OURS: peak})


def random_scores(grid: TangentGrid, apart: int = 32) -> torch.Tensor:
    """Scores of all images, float32: normal numbers some pixels apart, interpolated."""
    side = max(2, grid.dim // apart)
    size = (grid.num_images, NUM_CLASSES, side, side)
    scores = torch.randn(size, generator=torch.Generator().manual_seed(0))
    return functional.interpolate(scores, (grid.dim, grid.dim), mode="bilinear")


def _plain(
    scores: torch.Tensor, grid: TangentGrid, shape: tuple[int, int]
) -> Callable[[], torch.Tensor]:
    """The owner's bilinear scores of every pixel in one call, positions ready-made."""
    mosaic = scores.movedim(0, 1).reshape(1, NUM_CLASSES, -1, grid.dim)
    directions, places = equirect_directions(shape), np.empty((*shape, 2), np.float32)
    for row in range(shape[0]):  # all at once takes gigabytes
        owners = grid.owners(directions[row])
        u, v = grid.project(directions[row], owners).T
        place = u / (grid.dim - 1), (owners * grid.dim + v) / (mosaic.shape[2] - 1)
        places[row] = np.stack(place, axis=-1) * 2 - 1
    positions = torch.from_numpy(places)[None]
    sample = partial(functional.grid_sample, padding_mode="border", align_corners=True)
    return lambda: sample(mosaic, positions)[0].argmax(dim=0)


def memory_table(name: str, scores: torch.Tensor, added_mib: Mapping[str, float]) -> Table:
    """What renderers take at most, the scores included.

    Args:
        name: Of the benchmark.
        scores: Rendered.
        added_mib: See `peak_mib`, by renderer.
    """
    own = scores.nbytes / 2**20
    rows = [Row(renderer, [own + added], ours=True) for renderer, added in added_mib.items()]
    table = Table(f"{name}: memory, scores included", [Row("the scores", [own]), *rows], "MiB")
    table.goals = [Goal(f"{n}, of the scores' memory", table.ratio(n), 1.3) for n in added_mib]
    return table
