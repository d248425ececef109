"""Rendering tangent images, compared with bare `cv2.remap` and other libraries."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
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

_LARGE = 9
"""From this level on other libraries render a fifth of the images, which is multiplied."""

Render = Callable[[int], NDArray[Any]]


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
    faces = range(0, grid.num_images, step)
    ours = equirect_to_tangent(panorama, grid, faces)
    libraries = []
    for name, render in _rivals(panorama, grid).items():
        run = partial(lambda one: [one(face) for face in faces], render)
        _check_same_views(name, ours, run())
        libraries.append(Way(name, run, scale=step, rounds=3))
    four = [3, 20, 41, 77]
    own = [
        Way(BARE, bare),
        Way(ALL, lambda: equirect_to_tangent(panorama, grid), ours=True),
        Way(SOME, lambda: equirect_to_tangent(panorama, grid, four), ours=True),
    ]
    table = Table(f"images: level {level}, {dtype}", measure([*own, *libraries], rounds))
    table.goals = [
        Goal("all images, of bare cv2.remap's time", table.ratio(ALL), 1.25),
        Goal("4 images, of the time of all 80", table.ratio(SOME, ALL), 1 / 12),
        *(Goal(f"as fast as {w.name}", 1 / table.ratio(ALL, w.name), 1, True) for w in libraries),
    ]
    return table


def _striped_panorama(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Waves of 16 pixels along all axes, RGB from 28 to 228: half a pixel off is seen."""
    waves = np.sin(equirect_directions(shape) * (shape[1] / 16))
    return (128 + 100 * waves).astype(np.float32)


def _rivals(panorama: NDArray[Any], grid: TangentGrid) -> dict[str, Render]:
    """Other libraries, made to render this project's tangent images.

    Their conventions, in ours (centres of pixels are integers, yaw to the right, pitch up):

    * **py360convert**: the field of view spans the centres of the outermost pixels. It keeps the
      positions of its last views, and is given room for all of them.
    * **pyequilib**: the principal point is half the side, so one pixel less than ours is rendered;
      its panorama begins one row and one column further, so it gets a rolled one.
    """
    os.environ.setdefault("PY360CONVERT_CACHE_SIZE", "1024")  # read when it is imported
    import py360convert
    from equilib import Equi2Pers

    poses = xyz_to_lonlat(grid.centers_xyz)
    degrees = np.degrees(poses).tolist()
    size, side = (grid.dim, grid.dim), grid.dim - 1
    fov_deg = math.degrees(2 * math.atan(side / 2 * grid.pitch))
    view = Equi2Pers(height=side, width=side, fov_x=fov_deg, z_down=True)
    rolled = np.ascontiguousarray(np.roll(panorama, (1, 1), axis=(0, 1)).transpose(2, 0, 1))

    def pyequilib(face: int) -> NDArray[Any]:
        yaw, pitch = poses[face]
        image: Any = view(rolled, {"yaw": yaw, "pitch": pitch, "roll": 0.0})
        return image.transpose(1, 2, 0)

    return {
        "py360convert": lambda face: py360convert.e2p(panorama, fov_deg, *degrees[face], size),
        "pyequilib": pyequilib,
    }


def _check_same_views(name: str, ours: NDArray[Any], theirs: Sequence[NDArray[Any]]) -> None:
    """Refuse a comparison of different views.

    Args:
        name: Of the library.
        ours: ``(n, d, d, C)`` tangent images of a `_striped_panorama`.
        theirs: The same, up to a pixel smaller.

    Raises:
        RuntimeError: More than three pixels in a hundred differ by more than rounding; not all
            libraries join the panorama at its seam and poles.
    """
    for image, other in zip(ours, theirs, strict=True):
        height, width = other.shape[:2]
        difference = np.abs(image[:height, :width].astype(np.float64) - other).max(axis=-1)
        if min(height, width) < len(image) - 1 or np.mean(difference <= 4) < 0.97:
            raise RuntimeError(f"{name} renders other views; the comparison is void")
