"""Other libraries, made to render this project's tangent images.

Their conventions, in ours (centres of pixels are integers, yaw to the right, pitch up):

* **py360convert**, **pytorch360convert**: the field of view spans the centres of the outermost
  pixels. The first keeps the positions of its last views: it is given room for all of them.
* **pyequilib**: the principal point is half the side, so one pixel less than ours is rendered; and
  its panorama begins one row and one column further, so it gets a rolled one.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid, xyz_to_lonlat

__all__ = ["Render", "Rival", "check_same_views", "rivals", "striped_panorama"]

Render = Callable[[Sequence[int]], list[NDArray[Any]]]
"""Renders some of the tangent images."""

_ROOM = "1024"
_TOLERANCE = 4
"""Of 256 levels; the panorama changes by up to 39 of them per pixel."""
_SHARE = 0.97
"""Of the pixels: not all libraries join the panorama at its seam and poles."""


class Rival(NamedTuple):
    """Another library.

    Attributes:
        name: Its name.
        render: Renders some images of a panorama.
    """

    name: str
    render: Render


def striped_panorama(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Waves of 16 pixels along all axes, RGB from 28 to 228: half a pixel off is seen."""
    height, width = shape
    longitude = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    latitude = (np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi)[:, None]
    axes = (
        np.cos(latitude) * np.cos(longitude),
        np.cos(latitude) * np.sin(longitude),
        np.broadcast_to(np.sin(latitude), shape),
    )
    waves = [np.sin(axis * (width / 16)) for axis in axes]
    return (128 + 100 * np.stack(waves, axis=-1)).astype(np.float32)


def rivals(panorama: NDArray[Any], grid: TangentGrid) -> list[Rival]:
    """The libraries, ready to render images of this panorama.

    Raises:
        SettingError: One is not installed.
    """
    poses_deg = np.degrees(xyz_to_lonlat(grid.centers_xyz)).tolist()
    makers = (_py360convert, _pyequilib, _pytorch360convert)
    try:
        return [maker(panorama, grid, poses_deg) for maker in makers]
    except ImportError as error:
        raise SettingError(
            "benchmarks", found=f"no {error.name}", expected="the libraries it is compared with",
            remedy="pip install 'tangent-train[dev]'",
        ) from error  # fmt: skip


def _fov_deg(grid: TangentGrid, spaces: int) -> float:
    """The angle across so many spaces between pixels."""
    return math.degrees(2 * math.atan(spaces / 2 * grid.pitch))


def _py360convert(panorama: NDArray[Any], grid: TangentGrid, poses_deg: list[list[float]]) -> Rival:
    os.environ.setdefault("PY360CONVERT_CACHE_SIZE", _ROOM)  # read when it is imported
    import py360convert

    fov_deg, size = _fov_deg(grid, grid.dim - 1), (grid.dim, grid.dim)

    def render(faces: Sequence[int]) -> list[NDArray[Any]]:
        return [py360convert.e2p(panorama, fov_deg, *poses_deg[face], size) for face in faces]

    return Rival("py360convert", render)


def _pyequilib(panorama: NDArray[Any], grid: TangentGrid, poses_deg: list[list[float]]) -> Rival:
    from equilib import Equi2Pers

    side = grid.dim - 1
    view = Equi2Pers(height=side, width=side, fov_x=_fov_deg(grid, side), z_down=True)
    rolled = np.ascontiguousarray(np.roll(panorama, (1, 1), axis=(0, 1)).transpose(2, 0, 1))

    def one(face: int) -> NDArray[Any]:
        yaw, pitch = np.radians(poses_deg[face])
        image: Any = view(rolled, {"yaw": yaw, "pitch": pitch, "roll": 0.0})
        return image.transpose(1, 2, 0)

    return Rival("pyequilib", lambda faces: [one(face) for face in faces])


def _pytorch360convert(
    panorama: NDArray[Any], grid: TangentGrid, poses_deg: list[list[float]]
) -> Rival:
    from pytorch360convert import e2p

    fov_deg, size = _fov_deg(grid, grid.dim - 1), (grid.dim, grid.dim)
    floats = torch.from_numpy(panorama).float()  # it knows no other; ready-made

    def render(faces: Sequence[int]) -> list[NDArray[Any]]:
        views = (
            e2p(floats, fov_deg, *poses_deg[face], size, channels_first=False) for face in faces
        )
        return [view.numpy() for view in views]

    return Rival("pytorch360convert", render)


def check_same_views(name: str, ours: NDArray[Any], theirs: Sequence[NDArray[Any]]) -> None:
    """Refuse a comparison with something else.

    Args:
        name: Of the library.
        ours: ``(n, d, d, C)`` tangent images of a `striped_panorama`.
        theirs: The same, up to a pixel smaller.

    Raises:
        RuntimeError: More than three pixels in a hundred differ by more than rounding.
    """
    for image, other in zip(ours, theirs, strict=True):
        height, width = other.shape[:2]
        if min(height, width) < len(image) - 1:
            raise RuntimeError(f"{name} made {height} × {width} pixels instead of {len(image)}²")
        difference = np.abs(image[:height, :width].astype(np.float64) - other).max(axis=-1)
        share = np.mean(difference <= _TOLERANCE)
        if share < _SHARE:
            raise RuntimeError(
                f"{name} renders other views: {share:.1%} of the pixels agree; the comparison is "
                "void"
            )
