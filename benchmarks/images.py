"""Time rendering of tangent images, compared with bare `cv2.remap` and another library."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import Alternative, Goal, Table, expect_agreement, measure
from tangent_train.geometry import (
    TangentGrid,
    equirect_directions,
    equirect_shape,
    lonlat_to_equirect,
    xyz_to_lonlat,
)
from tangent_train.rendering import equirect_to_tangent

BARE = "bare cv2.remap, maps precomputed"
ALL = "equirect_to_tangent"
SOME = "equirect_to_tangent, 4 images"
LIBRARY = "pyequilib"

_LARGE = 9
"""From this level on the library renders a fifth of the images, and its time is multiplied by 5."""


def images(quick: bool) -> Iterator[Table]:
    """Yield a table for each level and dtype."""
    for dtype in (np.dtype(np.uint8), np.dtype(np.float32)):
        for level in (6,) if quick else (7, 8, 9, 10):
            yield _table(level, dtype, rounds=2 if quick else 11)


def _table(level: int, dtype: np.dtype[Any], rounds: int) -> Table:
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    # Waves of 16 pixels along all axes, from 28 to 228, reveal small shifts.
    waves = 128 + 100 * np.sin(equirect_directions(shape) * (shape[1] / 16))
    panorama = np.asarray(waves if dtype.kind == "f" else np.rint(waves)).astype(dtype)
    maps = [
        lonlat_to_equirect(xyz_to_lonlat(grid.directions([face])[0]), shape).astype(np.float32)
        for face in range(grid.num_images)
    ]

    def bare() -> list[Any]:
        mode = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_WRAP}
        return [cv2.remap(panorama, positions, None, **mode) for positions in maps]

    step = 5 if level >= _LARGE else 1
    faces, render = range(0, grid.num_images, step), _pyequilib(panorama, grid)
    equilib = np.stack(list(map(render, faces)))  # not interpolated across the seam and the poles
    side = equilib.shape[1]
    ours = equirect_to_tangent(panorama, grid, faces)[:, :side, :side].astype(np.float64)
    is_same = np.abs(ours - equilib).max(axis=-1) <= 4
    expect_agreement(LIBRARY, float(is_same.mean()), 0.97)
    four = [3, 20, 41, 77]
    alternatives = [
        Alternative(BARE, bare),
        Alternative(ALL, lambda: equirect_to_tangent(panorama, grid), is_ours=True),
        Alternative(SOME, lambda: equirect_to_tangent(panorama, grid, four), is_ours=True),
        Alternative(LIBRARY, lambda: list(map(render, faces)), scale=step, rounds=3),
    ]
    table = Table(f"images: level {level}, {dtype}", measure(alternatives, rounds))
    table.goals = [
        Goal("all images, of bare cv2.remap's time", table.ratio(ALL), 1.25),
        Goal("4 images, of the time of all 80", table.ratio(SOME, ALL), 1 / 12),
        Goal("as fast as the library", 1 / table.ratio(ALL, LIBRARY), 1, True),
    ]
    return table


def _pyequilib(panorama: NDArray[Any], grid: TangentGrid) -> Callable[[int], NDArray[Any]]:
    """Return a function that renders this project's tangent images with pyequilib.

    Its conventions differ: the principal point is half the side, so its images are one pixel
    smaller; its panorama starts one row and one column later, so it gets a rolled panorama.
    """
    from equilib import Equi2Pers

    side = grid.dim - 1
    fov_deg = math.degrees(2 * math.atan(side / 2 * grid.pitch))
    view = Equi2Pers(height=side, width=side, fov_x=fov_deg, z_down=True)
    rolled = np.ascontiguousarray(np.roll(panorama, (1, 1), axis=(0, 1)).transpose(2, 0, 1))
    poses = xyz_to_lonlat(grid.centers_xyz)

    def render(face: int) -> NDArray[Any]:
        yaw, pitch = poses[face]
        image: Any = view(rolled, {"yaw": yaw, "pitch": pitch, "roll": 0.0})
        return image.transpose(1, 2, 0)

    return render
