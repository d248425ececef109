"""Speed of rendering beside the obvious ways to do it: ``python -m benchmarks.rendering``.

Rows that belong together are run in turn, round after round, and medians are compared, so that
what else the machine does meets all of them.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from tangent_train.geometry import TangentGrid, equirect_shape, random_rotation
from tangent_train.rendering import (
    equirect_to_tangent,
    set_table_cache_limit,
    tangent_to_equirect,
    tangent_to_labels,
)
from tangent_train.rendering.tables import forward_map, owner_table

NUM_CLASSES = 13
FLOAT32 = np.dtype(np.float32)


class Row(NamedTuple):
    """One measured way to do something."""

    name: str
    run: Callable[[], object]


def main(arguments: list[str] | None = None) -> None:
    """Print the machine, then one table per comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a low level and few rounds")
    parser.add_argument("--rounds", type=int, default=5, help="measurements per row")
    options = parser.parse_args(arguments)
    level, rounds = (6, 2) if options.quick else (10, options.rounds)
    print(
        f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads; "
        f"Python {platform.python_version()}, torch {torch.__version__}, numba {numba.__version__},"
        f" OpenCV {cv2.__version__}, NumPy {np.__version__}"
    )
    grid = TangentGrid(1, level)
    height, width = equirect_shape(level)
    print(f"level {level}: {height}×{width}, {grid.num_images} images of {grid.dim}²")
    panorama = np.random.default_rng(0).integers(0, 256, (height, width, 3), np.uint8)
    compare("panorama (RGB, uint8) to images", forward_rows(panorama, grid), rounds)
    compare("small training sample", training_rows(), 20 * rounds)
    compare("tables, cold", table_rows(grid, (height, width)), rounds)
    compare(f"{NUM_CLASSES} scores to labels", label_rows(grid, (height, width)), rounds)
    level = min(level, 8)
    compare(f"torch, RGB float32, level {level}", torch_rows(TangentGrid(1, level)), rounds)


def compare(title: str, rows: list[Row], rounds: int) -> None:
    """Measure the rows in turn and print medians, with the ratio to the first."""
    for row in rows:
        row.run()  # compiles and fills caches
    seconds: list[list[float]] = [[] for _ in rows]
    for _ in range(rounds):
        for row, results in zip(rows, seconds, strict=True):
            start = time.perf_counter()
            row.run()
            results.append(time.perf_counter() - start)
    medians = [statistics.median(results) for results in seconds]
    print(f"\n{title}")
    for row, median in zip(rows, medians, strict=True):
        print(f"  {row.name:<58}{median * 1e3:>10.2f} ms{median / medians[0]:>9.3f}×")


def forward_rows(panorama: NDArray[np.uint8], grid: TangentGrid) -> list[Row]:
    """The library beside a bare loop over ready-made maps."""
    maps = [
        forward_map(grid, panorama.shape[:2], [face], FLOAT32) for face in range(grid.num_images)
    ]

    def bare() -> list[Any]:
        return [
            cv2.remap(panorama, m.u, m.v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            for m in maps
        ]

    four = [3, 20, 41, 77]
    return [
        Row("bare cv2.remap with ready-made maps, all images", bare),
        Row("equirect_to_tangent, all images", lambda: equirect_to_tangent(panorama, grid)),
        Row("equirect_to_tangent, 4 images", lambda: equirect_to_tangent(panorama, grid, four)),
    ]


def training_rows() -> list[Row]:
    """Five randomly turned images of a small panorama, as a data worker renders them."""
    rng = np.random.default_rng(0)
    panorama = rng.integers(0, 256, (128, 256, 3), np.uint8)

    def turned() -> object:
        grid = TangentGrid(0, 6, 48, rotation=random_rotation(rng))
        return equirect_to_tangent(panorama, grid, rng.permutation(20)[:5])

    fixed = TangentGrid(0, 6, 48)
    return [
        Row(
            "5 of 20 images of 48², fixed grid",
            lambda: equirect_to_tangent(panorama, fixed, range(5)),
        ),
        Row("5 of 20 images of 48², randomly turned grid", turned),
    ]


def table_rows(grid: TangentGrid, shape: tuple[int, int]) -> list[Row]:
    """Making the tables, the cache emptied before."""

    def cold(build: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            set_table_cache_limit(0)
            build()
            set_table_cache_limit(512 * 2**20)

        return run

    return [
        Row("owners (images to panorama)", cold(lambda: owner_table(grid, shape, FLOAT32))),
        Row(
            "maps of all images (panorama to images)",
            cold(lambda: [forward_map(grid, shape, [f], FLOAT32) for f in range(grid.num_images)]),
        ),
    ]


def label_rows(grid: TangentGrid, shape: tuple[int, int]) -> list[Row]:
    """The fused render beside two ways with grid_sample and argmax, positions ready-made.

    The plain way samples a mosaic of all images in one call. The careful way samples every image
    only where it owns the panorama, which is kinder to the caches.
    """
    size = (grid.num_images, NUM_CLASSES, grid.dim, grid.dim)
    scores = torch.from_numpy(np.random.default_rng(0).standard_normal(size, np.float32))
    mosaic = scores.movedim(0, 1).reshape(1, NUM_CLASSES, -1, grid.dim)
    face, u, v, _ = owner_table(grid, shape, FLOAT32)
    rows = face[0].astype(np.float64) * grid.dim + v[0]
    place = np.stack([u[0] / (grid.dim - 1), rows / (mosaic.shape[2] - 1)], axis=-1) * 2 - 1
    places = torch.from_numpy(place.astype(np.float32))[None]
    pixels = [torch.from_numpy(np.flatnonzero(face[0] == n)) for n in range(grid.num_images)]
    scale = 2 / (grid.dim - 1)
    inside = torch.from_numpy(np.stack([u[0].ravel(), v[0].ravel()], axis=-1) * scale - 1)
    owned = [inside[pixel][None, None] for pixel in pixels]

    def plain() -> torch.Tensor:
        return _grid_sample(mosaic, places)[0].argmax(dim=0)

    def careful() -> torch.Tensor:
        panorama = torch.empty(NUM_CLASSES, shape[0] * shape[1])
        for image, position, pixel in zip(scores, owned, pixels, strict=True):
            panorama[:, pixel] = _grid_sample(image[None], position)[0, :, 0]
        return panorama.argmax(dim=0).reshape(shape)

    array = scores.numpy()
    labels = tangent_to_labels(array, grid, shape)
    shares = [np.mean(way().numpy() == labels) for way in (plain, careful)]
    print("\nlabels agree with grid_sample's on", " and ".join(f"{s:.3%}" for s in shares))
    return [
        Row("torch grid_sample of a mosaic + argmax", plain),
        Row("torch grid_sample of the owned pixels + argmax", careful),
        Row("tangent_to_labels", lambda: tangent_to_labels(array, grid, shape)),
        Row("tangent_to_labels, feather", lambda: tangent_to_labels(array, grid, shape, "feather")),
    ]


def _grid_sample(images: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    return functional.grid_sample(images, places, padding_mode="border", align_corners=True)


def torch_rows(grid: TangentGrid) -> list[Row]:
    """The differentiable renderers on the CPU."""
    shape = equirect_shape(grid.level)
    image = torch.rand(3, *shape)
    images = equirect_to_tangent(image, grid)
    return [
        Row("equirect_to_tangent, all images", lambda: equirect_to_tangent(image, grid)),
        Row("tangent_to_equirect", lambda: tangent_to_equirect(images, grid, shape)),
        Row(
            "tangent_to_equirect, feather",
            lambda: tangent_to_equirect(images, grid, shape, "feather"),
        ),
    ]


if __name__ == "__main__":
    main()
