"""Tables of positions per grid and panorama size, kept in a bounded cache."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from os import register_at_fork
from threading import Lock
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tangent_train.errors import SettingError
from tangent_train.geometry import PinholeGrid
from tangent_train.rendering import kernels
from tangent_train.rendering.compiled import njit_exact, over_rows
from tangent_train.rendering.sampling import (
    Array,
    EquirectMap,
    equirect_map,
    plane_rays,
    sphere_rays,
)

Value = TypeVar("Value", bound=tuple[Any, ...])


class TableCache:
    """The most recently used tables, as many as fit into a number of bytes.

    Two threads that miss a table at once both build it, outside of the lock; one is kept.

    Args:
        limit: Maximum number of bytes held.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.nbytes = 0
        self._tables: OrderedDict[Hashable, tuple[Any, ...]] = OrderedDict()
        self._lock = Lock()
        register_at_fork(after_in_child=self._new_lock)

    def get(self, key: Hashable, build: Callable[[], Value]) -> Value:
        """The table of a key, built if it is not held.

        Args:
            key: Everything the table depends on.
            build: Makes the table, a tuple of arrays or tensors.
        """
        with self._lock:
            held: Any = self._tables.get(key)
            if held is not None:
                self._tables.move_to_end(key)
                return held
        table = build()
        with self._lock:
            size = _nbytes(table)
            if size <= self.limit and key not in self._tables:
                self._drop(self.limit - size)
                self._tables[key] = table
                self.nbytes += size
        return table

    def set_limit(self, limit: int) -> None:
        """Change the limit, dropping what no longer fits."""
        with self._lock:
            self.limit = limit
            self._drop(limit)

    def _drop(self, limit: int) -> None:
        while self.nbytes > limit:
            self.nbytes -= _nbytes(self._tables.popitem(last=False)[1])

    def _new_lock(self) -> None:
        """A process that was forked while another thread held the lock would wait forever."""
        self._lock = Lock()


def _nbytes(table: tuple[Any, ...]) -> int:
    return sum(part.nbytes for part in table)


TABLES = TableCache(limit=512 * 2**20)
_ROTATED_SHARE = 16
_ROTATED = TableCache(limit=TABLES.limit // _ROTATED_SHARE)
"""Of rotated grids, for depth and labels after RGB: random rotations would evict all others."""


def set_table_cache_limit(nbytes: int) -> None:
    """Bound the memory of the rendering tables of this process, 512 MiB at first.

    At level 10 and base level 1 the tables take 168 MB for panorama to images and, in PyTorch,
    117 MB back. Tables on a GPU count too; those of rotated grids have another sixteenth.

    Args:
        nbytes: Maximum number of bytes held; 0 disables the cache.

    Raises:
        SettingError: The number is negative.
    """
    if nbytes < 0:
        raise SettingError("table cache limit", found=nbytes, expected="0 bytes or more")
    TABLES.set_limit(nbytes)
    _ROTATED.set_limit(nbytes // _ROTATED_SHARE)


def _cached(grid: PinholeGrid, key: tuple[Hashable, ...], build: Callable[[], Value]) -> Value:
    return (TABLES if grid.rotation is None else _ROTATED).get((grid, *key), build)


def forward_map(
    grid: PinholeGrid,
    shape: tuple[int, int],
    faces: Sequence[int] | NDArray[np.int64],
    dtype: np.dtype[np.floating],
) -> EquirectMap:
    """Positions of the pixels of tangent images in the ERP, one image below the other.

    Args:
        grid: The images.
        shape: ``(H, W)`` of the ERP.
        faces: The images.
        dtype: float32 or float64; computed in float64 either way.
    """
    chosen = tuple(map(int, faces))

    def build() -> EquirectMap:
        world_from_pixel = grid.world_from_camera[list(chosen)] @ np.linalg.inv(grid.camera_matrix)
        rays = plane_rays((grid.dim, grid.dim))
        return equirect_map(world_from_pixel[..., [0, 2, 1]], rays, shape, dtype)

    return _cached(grid, ("forward", shape, chosen, dtype), build)


def forward_positions(
    grid: PinholeGrid, shape: tuple[int, int], faces: Sequence[int], dtype: np.dtype[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """The columns and rows of `forward_map` in the whole ERP, flat."""
    return forward_map(grid, shape, faces, dtype).in_panorama()


def owners(grid: PinholeGrid, shape: tuple[int, int]) -> NDArray[np.integer]:
    """``(H, W)`` the owner of every ERP pixel, in the smallest dtype that torch can index with."""

    def build() -> tuple[NDArray[np.integer]]:
        kinds = (np.uint8, np.int16, np.int32)
        face = np.empty(shape, next(k for k in kinds if grid.num_images <= np.iinfo(k).max + 1))
        centers = np.ascontiguousarray(grid.centers_xyz)
        rays = sphere_rays(shape)
        mesh = (centers, grid.neighbors, _inner_cosine(grid))
        over_rows(find_owners, *shape, *mesh, *rays, face)
        return (face,)

    return _cached(grid, ("owners", shape), build)[0]


def _inner_cosine(grid: PinholeGrid) -> float:
    """Cosine of half the angle between the nearest two centers: nearer to one is the nearest."""
    centers, around = grid.centers_xyz, grid.neighbors
    cosines = np.einsum("nkc,nc->nk", centers[around], centers)
    others = around != np.arange(grid.num_images)[:, None]
    return float(np.cos(np.arccos(cosines[others].max()) / 2))


@njit_exact
def find_owners(
    start: int, stop: int, centers: Array, neighbors: Array, inner: float,
    columns: Array, rows: Array, face: Array,
) -> None:  # fmt: skip
    """Find the image with the nearest center, for the ERP rows ``start:stop``.

    Steps to ever nearer centers, starting from the owner of the previous pixel.

    Args:
        start: First row.
        stop: One past the last row.
        centers: ``(N, 3)`` directions of the images' centers.
        neighbors: ``(N, k)`` images around every image.
        inner: Cosine of half the angle between the nearest two centers: a center nearer than that
            is the nearest.
        columns: From `sphere_rays`.
        rows: From `sphere_rays`.
        face: ``(H, W)`` owners, written.
    """
    nearest = 0
    for i in range(start, stop):
        z = rows[i, 1]
        for j in range(columns.shape[1]):
            x, y = rows[i, 0] * columns[0, j], rows[i, 0] * columns[1, j]
            best = centers[nearest, 0] * x + centers[nearest, 1] * y + centers[nearest, 2] * z
            while best < inner:
                nearer = nearest
                for other in neighbors[nearest]:
                    dot = centers[other, 0] * x + centers[other, 1] * y + centers[other, 2] * z
                    if dot > best:
                        best, nearer = dot, other
                if nearer == nearest:
                    break
                nearest = nearer
            face[i, j] = nearest


def image_table(
    grid: PinholeGrid,
    shape: tuple[int, int],
    dtype: np.dtype[np.floating],
    blend: str,
    rows: slice,
) -> tuple[NDArray[Any], ...]:
    """The images that contribute to the ERP pixels of some rows, and the positions in them.

    Args:
        grid: The images.
        shape: ``(H, W)`` of the ERP.
        dtype: Of positions and weights, float32 or float64; computed in float64 either way.
        blend: ``nearest``: the owner of every pixel, R = 1. ``feather``: R is the largest number of
            images that see a pixel.
        rows: The rows, without a step.

    Returns:
        ``(R, rows, W)`` each: images, int16 or int32; columns and rows in them; and weights that
        add up to 1.
    """
    part = owners(grid, shape)[rows] if blend == "nearest" else np.empty((0, 0), np.uint8)
    geometry = canvas_geometry(grid, grid.face_indices(), shape, rows, part)
    size = (rows.stop - rows.start, shape[1])

    def fill(ranks: int) -> tuple[NDArray[Any], ...]:
        count = np.zeros(size, np.int32)
        face = np.zeros((ranks, *size), np.int16 if grid.num_images < 2**15 else np.int32)
        u, v, weight = np.zeros((3, ranks, *size), dtype)
        table = (count, face, u, v, weight)
        over_rows(kernels.seen_table, *size, (grid.dim, grid.dim), geometry, *table)
        return table

    count, face, u, v, weight = fill(1 if blend == "nearest" else int(fill(0)[0].max()))
    # Pixels that fewer images see take their first one again, with weight 0.
    unused = np.arange(len(face))[:, None, None] >= count
    face, u, v = (np.where(unused, line[:1], line) for line in (face, u, v))
    return face, u, v, weight / weight.sum(axis=0)


def canvas_geometry(
    grid: PinholeGrid,
    faces: NDArray[np.int64],
    shape: tuple[int, int],
    rows: slice,
    owner: NDArray[np.integer],
) -> kernels.CanvasGeometry:
    """Geometry of images of a grid and rows of a panorama, for the kernels.

    Args:
        grid: Geometry of all images.
        faces: ``(n,)`` numbers of the images.
        shape: ``(H, W)`` of the panorama.
        rows: Rows of the panorama, without a step.
        owner: Owners of these rows; empty for feathering.
    """
    axes = grid.world_from_camera[faces]
    matrices = np.ascontiguousarray(grid.camera_matrix @ axes.transpose(0, 2, 1))
    columns, lines = sphere_rays(shape)
    spans = np.empty((0, 0, 2), np.int32) if owner.size else find_spans(grid, faces, shape, rows)
    return kernels.CanvasGeometry(faces, matrices, spans, columns, lines[rows], owner)


def find_spans(
    grid: PinholeGrid, faces: NDArray[np.int64], shape: tuple[int, int], rows: slice
) -> NDArray[np.int32]:
    """``(n, rows, 2)`` spans, see `kernels.CanvasGeometry`; arguments as of `canvas_geometry`."""

    def build() -> tuple[NDArray[np.int32]]:
        spans = np.empty((len(faces), rows.stop - rows.start, 2), np.int32)
        matrices = grid.camera_matrix @ grid.world_from_camera[faces].transpose(0, 2, 1)
        u, v, w = matrices[:, None].transpose(2, 0, 1, 3)
        last = grid.dim - 0.5
        edges = np.concatenate([u + w / 2, last * w - u, v + w / 2, last * w - v], axis=1)
        lines = sphere_rays(shape)[1][rows]
        over_rows(write_spans, spans.shape[1], len(faces), edges, lines, shape[1], spans)
        return (spans,)

    key = "spans", shape, rows.start, rows.stop, *map(int, faces)
    return _cached(grid, key, build)[0]


@njit_exact
def _inside(normals: Array, x: float, y: float, z: float) -> bool:
    """Whether a ray is on the inner side of planes, but for rounding."""
    inside = True
    for nx, ny, nz in normals:
        inside &= nx * x + ny * y + nz * z > -1e-6
    return inside


@njit_exact
def write_spans(start: int, stop: int, edges: Array, rows: Array, width: int, spans: Array) -> None:
    """Find the columns of ERP rows ``start:stop`` that may see something of images.

    An image is seen between four planes through the center of the sphere. What a row sees of it
    begins and ends where the row crosses one of them between the others.

    Args:
        start: First row.
        stop: One past the last row.
        edges: ``(n, 4, 3)`` normals of the planes, inwards.
        rows: From `sphere_rays`.
        width: W.
        spans: ``(n, H, 2)`` see `kernels.CanvasGeometry`, written.
    """
    for m in range(len(edges)):
        forward = edges[m, 0] + edges[m, 1]
        middle = math.atan2(forward[1], forward[0])
        x0, y0 = math.cos(middle), math.sin(middle)
        for i in range(start, stop):
            r, z = rows[i]
            least, most = math.inf, -math.inf
            for nx, ny, nz in edges[m]:
                ground = math.hypot(nx, ny)
                c = -nz * z / (r * ground)  # cosine of the angle from (nx, ny) to the crossings
                if not -1 < c < 1:
                    continue
                root = math.sqrt(1 - c * c)
                for s in (-root, root):
                    x, y = r * (nx * c - ny * s) / ground, r * (ny * c + nx * s) / ground
                    if _inside(edges[m], x, y, z):
                        angle = math.atan2(x0 * y - y0 * x, x0 * x + y0 * y)
                        least, most = min(least, angle), max(most, angle)
            # Opposite of its middle an image is seen only beyond a pole that it contains.
            if _inside(edges[m], -r * x0, -r * y0, z):
                least, most = -math.pi, math.pi
            spans[m, i] = 0
            if least <= most:
                first = math.floor(((middle + least) / (2 * math.pi) + 0.5) * width - 0.5)
                last = math.ceil(((middle + most) / (2 * math.pi) + 0.5) * width - 0.5)
                spans[m, i, 0], spans[m, i, 1] = first % width, min(last - first + 1, width)


def tensors_on(
    device: torch.device,
    grid: PinholeGrid,
    key: tuple[Hashable, ...] | None,
    build: Callable[[], tuple[NDArray[Any], ...]],
) -> tuple[Tensor, ...]:
    """Tables as tensors, kept; on the CPU they share the memory of the arrays.

    Args:
        device: Device of the tables.
        grid: Their grid.
        key: Everything else they depend on; None for tables that are not cached.
        build: Gives the arrays.
    """

    def tensors() -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(part).to(device) for part in build())

    return tensors() if key is None else _cached(grid, ("tensors", device, *key), tensors)
