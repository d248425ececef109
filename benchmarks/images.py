"""From panoramas to tangent images, beside bare `cv2.remap` and other libraries.

Random panoramas take as long as any: what is rendered is the one that shows whether the others'
views are the same.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from benchmarks.measuring import Options, Table, Way, at_least, at_most, measure
from benchmarks.rivals import check_same_views, rivals, striped_panorama
from tangent_train.geometry import TangentGrid, equirect_shape, random_rotation
from tangent_train.rendering import equirect_to_tangent
from tangent_train.rendering.tables import forward_map

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

__all__ = ["tables"]

BARE = "bare cv2.remap, maps ready-made"
ALL = "equirect_to_tangent"
SOME = "equirect_to_tangent, 4 images"

_LARGE = 9
"""From this level on other libraries render a fifth of the images, which is multiplied."""


def tables(options: Options) -> Iterator[Table]:
    """One for each level and dtype, and one of small samples."""
    levels = (6,) if options.quick else (7, 8, 9, 10)
    dtypes = (np.dtype(np.uint8), np.dtype(np.float32))
    for dtype in dtypes:
        for level in levels:
            yield _table(level, dtype, options)
    yield _small_samples(options)


def _table(level: int, dtype: np.dtype[Any], options: Options) -> Table:
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    floats = striped_panorama(shape)
    panorama: NDArray[Any] = floats if dtype.kind == "f" else np.rint(floats).astype(dtype)
    rows = measure(
        [*_own_ways(panorama, grid), *_rival_ways(panorama, grid, options)], options.times(11)
    )
    title = f"Level {level}, RGB {dtype}: {shape[0]}×{shape[1]} to {grid.num_images} of {grid.dim}²"
    table = Table(f"images: level {level}, {dtype}", title, rows)
    fastest = min(
        (row for row in rows if not row.ours and row.name != BARE), key=lambda r: r.median
    )
    table.goals = [
        at_most("all images, of bare cv2.remap's time", table.ratio(ALL).median, 1.25),
        at_most("4 images, of the time of all 80", table.ratio(SOME, ALL).median, 1 / 12),
        at_least(
            f"as fast as {fastest.name}, the fastest library",
            1 / table.ratio(ALL, fastest.name).median,
            1,
        ),
    ]
    return table


def _own_ways(panorama: NDArray[Any], grid: TangentGrid) -> list[Way]:
    shape, single = panorama.shape[:2], np.dtype(np.float32)
    maps = [forward_map(grid, shape, [face], single) for face in range(grid.num_images)]
    arrays = [(table.u, table.v) for table in maps]

    def bare() -> list[Any]:
        return [
            cv2.remap(panorama, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            for u, v in arrays
        ]

    four = [3, 20, 41, 77]
    return [
        Way(BARE, bare),
        Way(ALL, lambda: equirect_to_tangent(panorama, grid), ours=True),
        Way(SOME, lambda: equirect_to_tangent(panorama, grid, four), ours=True),
    ]


def _rival_ways(panorama: NDArray[Any], grid: TangentGrid, options: Options) -> list[Way]:
    step = 5 if grid.level >= _LARGE else 1
    faces = range(0, grid.num_images, step)
    ours = equirect_to_tangent(panorama, grid, faces)
    ways = []
    for rival in rivals(panorama, grid):
        check_same_views(rival.name, ours, rival.render(faces))
        run = lambda render=rival.render: render(faces)  # noqa: E731 - bound in this turn
        ways.append(Way(rival.name, run, scale=step, rounds=min(3, options.times(3))))
    return ways


def _small_samples(options: Options) -> Table:
    """Five images of a small panorama, as a data worker renders them."""
    rng = np.random.default_rng(0)
    panorama = rng.integers(0, 256, (128, 256, 3), np.uint8)
    fixed = TangentGrid(0, 6, 48)
    maps = [forward_map(fixed, (128, 256), [face], np.dtype(np.float32)) for face in range(5)]

    def bare() -> list[Any]:
        return [cv2.remap(panorama, m.u, m.v, cv2.INTER_LINEAR) for m in maps]

    def turned() -> object:
        grid = TangentGrid(0, 6, 48, rotation=random_rotation(rng))
        return equirect_to_tangent(panorama, grid, rng.permutation(20)[:5])

    ways = [
        Way(BARE, bare),
        Way("fixed", lambda: equirect_to_tangent(panorama, fixed, range(5)), ours=True),
        Way("turned at random, nothing ready-made", turned, ours=True),
    ]
    title = "Level 6, RGB uint8: 5 of 20 images of 48²"
    return Table("images: small samples", title, measure(ways, options.times(21)))
