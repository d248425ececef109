"""From scores to labels of the panorama, beside `grid_sample` and `argmax`.

Their positions are ready-made. The plain way samples a mosaic of all images in one call; the
careful way samples every image only where it owns the panorama, which is kinder to the caches.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.nn import functional

from benchmarks.measuring import (
    Options,
    Row,
    Table,
    Way,
    at_least,
    at_most,
    in_process,
    measure,
    memory_kib,
    peak_kib,
)
from tangent_train.geometry import TangentGrid, equirect_shape
from tangent_train.rendering import set_table_cache_limit, tangent_to_labels
from tangent_train.rendering.tables import forward_map, image_table, owners

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

__all__ = ["tables"]

NUM_CLASSES = 13
PLAIN = "grid_sample of a mosaic, argmax"
CAREFUL = "grid_sample of the owned pixels, argmax"
OURS = "tangent_to_labels"
SCORES = "the scores"

_SINGLE = np.dtype(np.float32)
_AGREEMENT = 0.995


def tables(options: Options) -> Iterator[Table]:
    """Time, tables, memory; and time on a GPU where there is one."""
    level = 6 if options.quick else 10
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    yield _times(grid, shape, options)
    yield _cold_tables(grid, shape, options)
    yield _memory(level, options)
    if torch.cuda.is_available():
        yield _on_gpu(grid, shape, options)


def _title(grid: TangentGrid, shape: tuple[int, int]) -> str:
    images = f"{grid.num_images} images of {grid.dim}²"
    return f"{NUM_CLASSES} scores of {images} to {shape[0]}×{shape[1]} labels"


def random_scores(grid: TangentGrid, classes: int = NUM_CLASSES) -> torch.Tensor:
    """Scores of all images, float32."""
    size = (grid.num_images, classes, grid.dim, grid.dim)
    return torch.randn(size, generator=torch.Generator().manual_seed(0))


def _times(grid: TangentGrid, shape: tuple[int, int], options: Options) -> Table:
    scores = random_scores(grid)
    array = scores.numpy()
    plain, careful = _plain(scores, grid, shape), _careful(scores, grid, shape)
    labels = tangent_to_labels(array, grid, shape)
    for name, way in ((PLAIN, plain), (CAREFUL, careful)):
        share = np.mean(way().numpy() == labels)
        if share < _AGREEMENT:
            raise RuntimeError(f"{name} gives other labels: {share:.1%} agree")
    rows = measure(
        [
            Way(PLAIN, plain),
            Way(CAREFUL, careful),
            Way(OURS, lambda: tangent_to_labels(array, grid, shape), ours=True),
            Way(
                f"{OURS}, feather",
                lambda: tangent_to_labels(array, grid, shape, "feather"),
                ours=True,
                rounds=options.times(3),
            ),
        ],
        options.times(7),
    )
    table = Table("labels: time", f"{_title(grid, shape)}, tables warm", rows)
    for name in (PLAIN, CAREFUL):
        table.goals.append(at_least(f"as fast as {name}", 1 / table.ratio(OURS, name).median, 20))
    return table


def _plain(
    scores: torch.Tensor, grid: TangentGrid, shape: tuple[int, int]
) -> Callable[[], torch.Tensor]:
    mosaic = scores.movedim(0, 1).reshape(1, NUM_CLASSES, -1, grid.dim)
    face, u, v, _ = image_table(grid, shape, _SINGLE, "nearest", slice(0, shape[0]))
    rows = face[0].astype(np.float64) * grid.dim + v[0]
    place = np.stack([u[0] / (grid.dim - 1), rows / (mosaic.shape[2] - 1)], axis=-1) * 2 - 1
    places = torch.from_numpy(place.astype(np.float32))[None]
    return lambda: _grid_sample(mosaic, places)[0].argmax(dim=0)


def _careful(
    scores: torch.Tensor, grid: TangentGrid, shape: tuple[int, int]
) -> Callable[[], torch.Tensor]:
    face, u, v, _ = image_table(grid, shape, _SINGLE, "nearest", slice(0, shape[0]))
    scale = 2 / (grid.dim - 1)
    inside = torch.from_numpy(np.stack([u[0].ravel(), v[0].ravel()], axis=-1) * scale - 1)
    pixels = [torch.from_numpy(np.flatnonzero(face[0] == n)) for n in range(grid.num_images)]
    owned = [inside[pixel][None, None] for pixel in pixels]

    def run() -> torch.Tensor:
        panorama = torch.empty(NUM_CLASSES, shape[0] * shape[1])
        for image, position, pixel in zip(scores, owned, pixels, strict=True):
            panorama[:, pixel] = _grid_sample(image[None], position)[0, :, 0]
        return panorama.argmax(dim=0).reshape(shape)

    return run


def _grid_sample(images: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    return functional.grid_sample(images, places, padding_mode="border", align_corners=True)


def _cold_tables(grid: TangentGrid, shape: tuple[int, int], options: Options) -> Table:
    """Making the tables, the cache emptied before."""

    def cold(build: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            set_table_cache_limit(0)
            build()
            set_table_cache_limit(512 * 2**20)

        return run

    coordinates = np.random.default_rng(0).standard_normal((2, *shape))
    owned = "owners of all pixels (to labels)"
    rows = measure(
        [
            Way("for scale: numpy.arctan2 of as many pixels", lambda: np.arctan2(*coordinates)),
            Way(owned, cold(lambda: owners(grid, shape)), ours=True),
            Way(
                "maps of all images (to images)",
                cold(lambda: [forward_map(grid, shape, [f], _SINGLE) for f in grid.face_indices()]),
                ours=True,
            ),
        ],
        options.times(7),
    )
    table = Table("labels: tables", f"Tables of a new size, once ({shape[0]}×{shape[1]})", rows)
    table.goals = [at_most("table of the owners", table.row(owned).median, 0.5, " s")]
    return table


def _memory(level: int, options: Options) -> Table:
    """The peak of a new process, scores included, in each way."""
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    ways = {PLAIN: False, OURS: True}
    rounds = options.times(1)
    scores_mib = grid.num_images * NUM_CLASSES * grid.dim**2 * 4 / 2**20
    rows = [Row(SCORES, [scores_mib] * rounds)]
    for name, ours in ways.items():
        added = [in_process(_added_mib, level, ours) for _ in range(rounds)]
        rows.append(Row(f"with {name}, at most", [scores_mib + mib for mib in added], ours))
    table = Table("labels: memory", f"Memory: {_title(grid, shape)}, tables included", rows, "MiB")
    found = table.ratio(f"with {OURS}, at most").median
    table.goals = [at_most("memory, of the scores'", found, 1.3)]
    return table


def _added_mib(level: int, ours: bool) -> float:
    """What one rendering adds to the scores, the code compiled before at a low level."""
    small, (grid, shape) = TangentGrid(1, 6), (TangentGrid(1, level), equirect_shape(level))
    tangent_to_labels(random_scores(small), small, equirect_shape(6))
    scores = random_scores(grid)
    before = memory_kib("VmRSS")
    labels = tangent_to_labels(scores, grid, shape) if ours else _plain(scores, grid, shape)()
    added = peak_kib() - before
    del labels
    return max(0, added) / 2**10


def _on_gpu(grid: TangentGrid, shape: tuple[int, int], options: Options) -> Table:
    """Beside reading the scores once."""
    device = torch.device("cuda")
    scores = random_scores(grid).to(device)

    def read() -> None:
        scores.sum()
        torch.cuda.synchronize()

    def render() -> None:
        tangent_to_labels(scores, grid, shape)
        torch.cuda.synchronize()

    reading = "reading the scores once (their sum)"
    rows = measure(
        [
            Way(reading, read),
            Way(OURS, render, ours=True),
        ],
        options.times(21),
    )
    own = torch.from_numpy(tangent_to_labels(scores.cpu().numpy(), grid, shape))
    share = (tangent_to_labels(scores, grid, shape).cpu() == own).double().mean().item()
    if share < _AGREEMENT:
        raise RuntimeError(f"the GPU gives other labels: {share:.1%} agree")
    table = Table("labels: on a GPU", f"{_title(grid, shape)}, on a GPU", rows)
    table.goals = [at_most("of the time of reading the scores once", table.ratio(OURS).median, 2)]
    return table
