"""Where pixels come from: tables per grid and panorama size, kept in a bounded cache."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import PinholeGrid
from tangent_train.rendering import feather_kernels, kernels
from tangent_train.rendering.sampling import EquirectMap, pinhole_equirect_map
from tangent_train.rendering.threads import over_rows

__all__ = [
    "FEATHER_POWER",
    "ImageTable",
    "TableCache",
    "feather_arguments",
    "feather_table",
    "forward_map",
    "owner_arguments",
    "owner_table",
    "set_table_cache_limit",
    "tensors_on",
]

FEATHER_POWER = 4
"""Exponent p of the feather weights ((1 − a²)(1 − b²))^p at offsets a, b in half image sides."""

Value = TypeVar("Value")


class ImageTable(NamedTuple):
    """Where ERP pixels are in the tangent images that see them.

    Attributes:
        face: ``(R, H, W)`` images, uint8, int16 or int32.
        u: ``(R, H, W)`` columns in the images.
        v: ``(R, H, W)`` rows in the images.
        weight: ``(R, H, W)`` weights that add up to 1, or None where R = 1.
    """

    face: NDArray[np.integer]
    u: NDArray[np.floating]
    v: NDArray[np.floating]
    weight: NDArray[np.floating] | None

    @property
    def arrays(self) -> tuple[NDArray[Any], ...]:
        """The tables that are there."""
        return tuple(part for part in self if part is not None)

    @property
    def nbytes(self) -> int:
        """Memory of the tables."""
        return sum(part.nbytes for part in self.arrays)


class TableCache:
    """The most recently used values, as many as fit into a number of bytes. Thread-safe.

    Args:
        limit: Most bytes held.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.nbytes = 0
        self._values: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self._renew_lock()
        # Forked while another thread holds the lock, a child would wait for it for ever.
        os.register_at_fork(after_in_child=self._renew_lock)

    def _renew_lock(self) -> None:
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def get(
        self, key: Hashable, build: Callable[[], Value], nbytes: Callable[[Value], int]
    ) -> Value:
        """The value of a key, built if it is not held.

        Args:
            key: What the value depends on.
            build: Makes the value; may run twice when two threads miss at once.
            nbytes: Size of the value.
        """
        with self._lock:
            entry = self._values.get(key)
            if entry is not None:
                self._values.move_to_end(key)
                held: Value = entry[0]
                return held
        value = build()
        size = nbytes(value)
        with self._lock:
            if key not in self._values and size <= self.limit:
                self._values[key] = value, size
                self.nbytes += size
                self._shrink()
        return value

    def set_limit(self, limit: int) -> None:
        """Change the limit, dropping what no longer fits."""
        with self._lock:
            self.limit = limit
            self._shrink()

    def _shrink(self) -> None:
        while self.nbytes > self.limit:
            _, (_, size) = self._values.popitem(last=False)
            self.nbytes -= size


TABLES = TableCache(limit=512 * 2**20)


def set_table_cache_limit(nbytes: int) -> None:
    """Bound the memory of the rendering tables of this process, 512 MiB at first.

    At level 10 and base level 1 the tables take 168 MB for panorama to images and 76 MB back.
    Tables on a GPU count too.

    Args:
        nbytes: Most bytes held; 0 keeps nothing.

    Raises:
        SettingError: The number is negative.
    """
    if nbytes < 0:
        raise SettingError("table cache limit", found=nbytes, expected="0 bytes or more")
    TABLES.set_limit(nbytes)


def _cached(
    grid: PinholeGrid,
    key: tuple[Hashable, ...],
    build: Callable[[], Value],
    nbytes: Callable[[Value], int],
) -> Value:
    """Tables of rotated grids are not kept: random rotations would push out all others."""
    if grid.rotation is not None:
        return build()
    return TABLES.get((grid, *key), build, nbytes)


def forward_map(
    grid: PinholeGrid,
    shape: tuple[int, int],
    faces: Sequence[int] | NDArray[np.int64],
    dtype: np.dtype[np.floating],
) -> EquirectMap:
    """Where the pixels of tangent images are in the ERP, one below the other.

    Args:
        grid: The images.
        shape: ``(H, W)`` of the ERP.
        faces: The images.
        dtype: float32 or float64; computed in float64 either way.
    """
    chosen = tuple(map(int, faces))

    def build() -> EquirectMap:
        world_from_pixel = grid.world_from_camera[list(chosen)] @ np.linalg.inv(grid.camera_matrix)
        return pinhole_equirect_map(world_from_pixel, (grid.dim, grid.dim), shape, dtype)

    return _cached(grid, ("forward", shape, chosen, dtype), build, lambda table: table.nbytes)


def owner_table(
    grid: PinholeGrid, shape: tuple[int, int], dtype: np.dtype[np.floating]
) -> ImageTable:
    """The owner of every ERP pixel, and where it is in the owner's image.

    Args:
        grid: The images.
        shape: ``(H, W)`` of the ERP.
        dtype: Of the positions, float32 or float64; computed in float64 either way.

    Returns:
        A table with R = 1.
    """

    def build() -> ImageTable:
        face = np.empty((1, *shape), _face_dtype(grid))
        u, v = np.empty((2, 1, *shape), dtype)
        center = (grid.dim - 1) / 2
        mesh = (_axes(grid), grid.neighbors, _inner_cosine(grid), 1 / grid.pitch, center)
        rays = kernels.directions_of_rows(*shape)
        over_rows(kernels.owner_table, shape, *mesh, *rays, face[0], u[0], v[0])
        return ImageTable(face, u, v, None)

    return _cached(grid, ("owner", shape, dtype), build, lambda table: table.nbytes)


def feather_table(
    grid: PinholeGrid, shape: tuple[int, int], dtype: np.dtype[np.floating], rows: slice
) -> ImageTable:
    """All images that see the ERP pixels of some rows; kept where they are all rows.

    Args:
        grid: The images.
        shape: ``(H, W)`` of the ERP.
        dtype: Of positions and weights, float32 or float64; computed in float64 either way.
        rows: The rows, without a step.

    Returns:
        A table of these rows, R the largest number of images that see one of its pixels.
    """

    def build() -> ImageTable:
        owners, near, axes, focal, power, columns, lines = feather_arguments(grid, shape)
        part = owners[rows]
        arguments = (part, near, axes, focal, grid.dim / 2, power, columns, lines[rows])
        count = np.zeros(part.shape, np.int32)
        for ranks in (0, None):
            size = (count.max(initial=0) if ranks is None else ranks, *part.shape)
            count[:] = 0
            face, (u, v) = np.empty(size, owners.dtype), np.empty((2, *size), dtype)
            weight = np.zeros(size, dtype)
            over_rows(
                feather_kernels.feather_table, part.shape, *arguments, count, face, u, v, weight
            )
        return ImageTable(face, u, v, weight)

    if (rows.start, rows.stop) != (0, shape[0]):
        return build()
    return _cached(grid, ("feather", shape, dtype), build, lambda table: table.nbytes)


def feather_arguments(grid: PinholeGrid, shape: tuple[int, int]) -> tuple[Any, ...]:
    """Owners, near images, axes, focal length, power, columns and rows, for the kernels."""
    owners, axes, focal, *rays = owner_arguments(grid, shape)
    return owners, _near_images(grid), axes, focal, FEATHER_POWER, *rays


def owner_arguments(grid: PinholeGrid, shape: tuple[int, int]) -> tuple[Any, ...]:
    """Owners, axes, focal length, columns and rows, for the kernels."""
    owners = owner_table(grid, shape, np.dtype(np.float32)).face[0]
    return owners, _axes(grid), 1 / grid.pitch, *kernels.directions_of_rows(*shape)


def tensors_on(
    device: torch.device,
    grid: PinholeGrid,
    key: tuple[Hashable, ...] | None,
    build: Callable[[], tuple[NDArray[Any], ...]],
) -> tuple[Tensor, ...]:
    """Tables as tensors: shared with NumPy on the CPU, copied once to any other device.

    Args:
        device: Where they are needed.
        grid: What they belong to.
        key: What else they depend on; None for tables that are not kept.
        build: Gives the arrays.
    """

    def tensors() -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(part).to(device) for part in build())

    if device.type == "cpu" or key is None:
        return tensors()
    key = ("tensors", device, *key)
    return _cached(grid, key, tensors, lambda parts: sum(part.nbytes for part in parts))


def _axes(grid: PinholeGrid) -> NDArray[np.float64]:
    return np.ascontiguousarray(grid.world_from_camera)


def _face_dtype(grid: PinholeGrid) -> type[np.integer]:
    """The smallest integer for face indices that torch can convert (it hardly knows uint16)."""
    return next(
        kind for kind in (np.uint8, np.int16, np.int32) if grid.num_images <= np.iinfo(kind).max + 1
    )


def _inner_cosine(grid: PinholeGrid) -> float:
    """Cosine of half the angle between the nearest two centres: nearer to one is the nearest."""
    centers, around = grid.centers_xyz, grid.neighbors
    cosines = np.einsum("nkc,nc->nk", centers[around], centers)
    others = around != np.arange(grid.num_images)[:, None]
    return float(np.cos(np.arccos(cosines[others].max()) / 2))


def _near_images(grid: PinholeGrid) -> NDArray[np.int32]:
    """``(N, M)`` images that can see something a face owns, filled up with −1.

    What a face owns and what an image sees both lie inside an image's corners.
    """

    def build() -> NDArray[np.int32]:
        corner = np.arctan(np.sqrt(2) * grid.dim / 2 * grid.pitch)
        closest = np.cos(min(2 * corner, np.pi))
        rows = [np.flatnonzero(grid.centers_xyz @ center >= closest) for center in grid.centers_xyz]
        near = np.full((len(rows), max(map(len, rows))), -1, np.int32)
        for face, images in enumerate(rows):
            near[face, : len(images)] = images
        return near

    return _cached(grid, ("near",), build, lambda near: near.nbytes)
