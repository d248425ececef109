"""Rendering tangent images, compared with bare `cv2.remap` and another library."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import Goal, Table, Way, measure
from tangent_train.geometry import (
    TangentGrid,
    equirect_directions,
    equirect_shape,
    lonlat_to_equirect,
    xyz_to_lonlat,
)
from tangent_train.rendering import equirect_to_tangent

BARE = "bare cv2.remap, maps ready-made"
ALL = "equirect_to_tangent"
SOME = "equirect_to_tangent, 4 images"
LIBRARY = "pyequilib"

_LARGE = 9
"""From this level on the library renders a fifth of the images, which is multiplied."""


def images(quick: bool) -> Iterator[Table]:
    """One for each level and dtype."""
    for dtype in (np.dtype(np.uint8), np.dtype(np.float32)):
        for level in (6,) if quick else (7, 8, 9, 10):
            yield _table(level, dtype, rounds=2 if quick else 11)


def _table(level: int, dtype: np.dtype[Any], rounds: int) -> Table:
    grid, shape = TangentGrid(1, level), equirect_shape(level)
    striped = _striped_panorama(shape)
    panorama = striped if dtype.kind == "f" else np.rint(striped).astype(dtype)
    maps = [
        lonlat_to_equirect(xyz_to_lonlat(grid.directions([face])[0]), shape).astype(np.float32)
        for face in range(grid.num_images)
    ]

    def bare() -> list[Any]:
        mode = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_WRAP}
        return [cv2.remap(panorama, places, None, **mode) for places in maps]

    step = 5 if level >= _LARGE else 1
    faces, render = range(0, grid.num_images, step), _pyequilib(panorama, grid)
    _check_same_views(equirect_to_tangent(panorama, grid, faces), list(map(render, faces)))
    four = [3, 20, 41, 77]
    ways = [
        Way(BARE, bare),
        Way(ALL, lambda: equirect_to_tangent(panorama, grid), ours=True),
        Way(SOME, lambda: equirect_to_tangent(panorama, grid, four), ours=True),
        Way(LIBRARY, lambda: list(map(render, faces)), scale=step, rounds=3),
    ]
    table = Table(f"images: level {level}, {dtype}", measure(ways, rounds))
    table.goals = [
        Goal("all images, of bare cv2.remap's time", table.ratio(ALL), 1.25),
        Goal("4 images, of the time of all 80", table.ratio(SOME, ALL), 1 / 12),
        Goal("as fast as the library", 1 / table.ratio(ALL, LIBRARY), 1, True),
    ]
    return table


def _striped_panorama(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Waves of 16 pixels along all axes, RGB from 28 to 228: half a pixel off is seen."""
    waves = np.sin(equirect_directions(shape) * (shape[1] / 16))
    return (128 + 100 * waves).astype(np.float32)


def _pyequilib(panorama: NDArray[Any], grid: TangentGrid) -> Callable[[int], NDArray[Any]]:
    """That library, made to render this project's tangent images.

    Its conventions, in ours (centres of pixels are integers, yaw to the right, pitch up): the
    principal point is half the side, so one pixel less than ours is rendered; its panorama begins
    one row and one column further, so it gets a rolled one.
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


def _check_same_views(ours: NDArray[Any], theirs: Sequence[NDArray[Any]]) -> None:
    """Refuse a comparison of different views.

    Args:
        ours: ``(n, d, d, C)`` tangent images of a `_striped_panorama`.
        theirs: The same, up to a pixel smaller.

    Raises:
        RuntimeError: More than three pixels in a hundred differ by more than rounding; at the
            seam and the poles the library does not join the panorama.
    """
    for image, other in zip(ours, theirs, strict=True):
        height, width = other.shape[:2]
        difference = np.abs(image[:height, :width].astype(np.float64) - other).max(axis=-1)
        if min(height, width) < len(image) - 1 or np.mean(difference <= 4) < 0.97:
            raise RuntimeError(f"{LIBRARY} renders other views; the comparison is void")
