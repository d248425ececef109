"""Tables of positions per grid and panorama size, in a cache of limited size."""

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
from tangent_train.geometry import PinholeGrid, xyz_to_lonlat
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
    """A cache of the most recently used tables, limited by their bytes.

    If two threads need a missing table at once, both build it, outside of the lock; one is kept.

    Args:
        limit: Maximum number of bytes in the cache.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.nbytes = 0
        self._tables: OrderedDict[Hashable, tuple[Any, ...]] = OrderedDict()
        self._lock = Lock()
        register_at_fork(after_in_child=self._new_lock)

    def get(self, key: Hashable, build: Callable[[], Value]) -> Value:
        """Return the table of a key, and build it if it is not in the cache.

        Args:
            key: All values that the table depends on.
            build: Function that builds the table, a tuple of arrays or tensors.
        """
        with self._lock:
            cached: Any = self._tables.get(key)
            if cached is not None:
                self._tables.move_to_end(key)
                return cached
        table = build()
        with self._lock:
            size = _nbytes(table)
            if size <= self.limit and key not in self._tables:
                self._drop(self.limit - size)
                self._tables[key] = table
                self.nbytes += size
        return table

    def set_limit(self, limit: int) -> None:
        """Change the limit and drop tables that no longer fit."""
        with self._lock:
            self.limit = limit
            self._drop(limit)

    def _drop(self, limit: int) -> None:
        while self.nbytes > limit:
            self.nbytes -= _nbytes(self._tables.popitem(last=False)[1])

    def _new_lock(self) -> None:
        """Replace the lock in a forked process: it may have been locked by another thread."""
        self._lock = Lock()


def _nbytes(table: tuple[Any, ...]) -> int:
    return sum(part.nbytes for part in table)


TABLES = TableCache(limit=512 * 2**20)
_ROTATED_SHARE = 16
_ROTATED = TableCache(limit=TABLES.limit // _ROTATED_SHARE)
"""Tables of rotated grids, reused for depth and labels after RGB. They have a separate cache,
because random rotations would evict all other tables."""


def set_table_cache_limit(nbytes: int) -> None:
    """Limit the memory of the rendering tables of this process; the default is 512 MiB.

    At level 10 and base level 1 the tables take 168 MB from panorama to images and, for tensors,
    117 MB back. Tables on a GPU count too. Tables of rotated grids may use another sixteenth.

    Args:
        nbytes: Maximum number of bytes in the cache; 0 disables it.

    Raises:
        SettingError: The number is negative.
    """
    if nbytes < 0:
        raise SettingError("table cache limit", found=nbytes, expected="0 bytes or more")
    TABLES.set_limit(nbytes)
    _ROTATED.set_limit(nbytes // _ROTATED_SHARE)


def cached(key: Hashable, build: Callable[[], Value], *, is_rotated: bool) -> Value:
    """Return the table of a key from one of the two caches, see `TableCache.get`."""
    return (_ROTATED if is_rotated else TABLES).get(key, build)


def _cached(grid: PinholeGrid, key: tuple[Hashable, ...], build: Callable[[], Value]) -> Value:
    return cached((grid, *key), build, is_rotated=grid.rotation is not None)


def forward_map(
    grid: PinholeGrid,
    shape: tuple[int, int],
    faces: Sequence[int] | NDArray[np.int64],
    dtype: np.dtype[np.floating],
) -> EquirectMap:
    """Return positions in the ERP of the pixels of tangent images, stacked vertically.

    Args:
        grid: Geometry of the images.
        shape: ``(H, W)`` of the ERP.
        faces: Indices of the images.
        dtype: float32 or float64; the computation is float64 in both cases.
    """
    chosen = tuple(map(int, faces))

    def build() -> EquirectMap:
        world_from_pixel = grid.world_from_camera[list(chosen)] @ np.linalg.inv(grid.camera_matrix)
        rays = plane_rays(grid.size)
        return equirect_map(world_from_pixel[..., [0, 2, 1]], rays, shape, dtype)

    return _cached(grid, ("forward", shape, chosen, dtype), build)


def forward_positions(
    grid: PinholeGrid, shape: tuple[int, int], faces: Sequence[int], dtype: np.dtype[np.floating]
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the columns and rows of `forward_map` in the whole ERP, flat."""
    return forward_map(grid, shape, faces, dtype).in_panorama()


def owners(grid: PinholeGrid, shape: tuple[int, int]) -> NDArray[np.integer]:
    """Return the owner of every ERP pixel, ``(H, W)``, in the smallest integer dtype that fits."""

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
    """Return the cosine of half the smallest angle between two centers."""
    centers, around = grid.centers_xyz, grid.neighbors
    cosines = np.einsum("nkc,nc->nk", centers[around], centers)
    others = around != np.arange(grid.num_images)[:, None]
    return float(np.cos(np.arccos(cosines[others].max(initial=-1.0)) / 2))


@njit_exact
def find_owners(
    start: int, stop: int, centers: Array, neighbors: Array, inner: float,
    columns: Array, rows: Array, face: Array,
) -> None:  # fmt: skip
    """Find the image with the nearest center, for the ERP rows ``start:stop``.

    Starting from the owner of the previous pixel, the search steps to ever nearer neighbors.

    Args:
        start: First row.
        stop: One past the last row.
        centers: ``(N, 3)`` directions of the images' centers.
        neighbors: ``(N, k)`` images around every image.
        inner: Cosine of half the smallest angle between two centers: a center within that angle is
            the nearest one.
        columns: ``(2, W)`` factors from `sphere_rays`.
        rows: ``(H, 2)`` factors from `sphere_rays`.
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


def find_owned_spans(
    grid: PinholeGrid, faces: NDArray[np.int64], shape: tuple[int, int]
) -> NDArray[np.int32]:
    """Return ``(n, H, 2)`` spans that contain the owned pixels, see `kernels.CanvasGeometry`.

    Args:
        grid: Geometry of all images.
        faces: ``(n,)`` indices of the images.
        shape: ``(H, W)`` of the panorama.
    """

    def build() -> tuple[NDArray[np.int32]]:
        longitudes = xyz_to_lonlat(grid.centers_xyz)[:, 0]
        before = (longitudes / (2 * math.pi) * shape[1]).astype(np.int64)
        spans = np.zeros((grid.num_images, shape[0], 2), np.int32)
        over_rows(write_owned_spans, *shape, owners(grid, shape), before, spans)
        return (spans,)

    return _cached(grid, ("owned spans", shape), build)[0][faces]


@njit_exact
def write_owned_spans(start: int, stop: int, owner: Array, before: Array, spans: Array) -> None:
    """Find the columns of ERP rows ``start:stop`` that images own.

    Args:
        start: First row.
        stop: One past the last row.
        owner: ``(H, W)`` owners.
        before: ``(N,)`` column opposite to the center of each image, modulo W.
        spans: ``(N, H, 2)`` spans, 0 at first, written.
    """
    width = owner.shape[1]
    for i in range(start, stop):
        for j in range(width):
            m = owner[i, j]
            away = (j - before[m]) % width
            if spans[m, i, 1] == 0:
                spans[m, i, 0] = away
            spans[m, i, 0] = min(spans[m, i, 0], away)
            spans[m, i, 1] = max(spans[m, i, 1], away + 1)
        for m in range(len(spans)):
            spans[m, i, 1] -= spans[m, i, 0]
            spans[m, i, 0] = (spans[m, i, 0] + before[m]) % width


def image_table(
    grid: PinholeGrid,
    shape: tuple[int, int],
    dtype: np.dtype[np.floating],
    blend: str,
    rows: slice,
) -> tuple[NDArray[Any], ...]:
    """Return the images that contribute to the ERP pixels of some rows, and positions in them.

    Args:
        grid: Geometry of the images.
        shape: ``(H, W)`` of the ERP.
        dtype: dtype of positions and weights, float32 or float64; they are computed in float64.
        blend: ``nearest``: the owner of every pixel, R = 1. ``feather``: all images that cover a
            pixel; R is the largest number of them.
        rows: Rows of the ERP, without a step.

    Returns:
        Four arrays ``(R, rows, W)``: indices of images, int16 or int32; columns and rows in the
        images; and weights that add up to 1.
    """
    part = owners(grid, shape)[rows] if blend == "nearest" else np.empty((0, 0), np.uint8)
    geometry = canvas_geometry(grid, grid.face_indices(), shape, rows, part)
    size = (rows.stop - rows.start, shape[1])

    def fill(ranks: int) -> tuple[NDArray[Any], ...]:
        count = np.zeros(size, np.int32)
        face = np.zeros((ranks, *size), np.int16 if grid.num_images < 2**15 else np.int32)
        u, v, weight = np.zeros((3, ranks, *size), dtype)
        table = (count, face, u, v, weight)
        over_rows(kernels.seen_table, *size, grid.size, geometry, *table)
        return table

    count, face, u, v, weight = fill(1 if blend == "nearest" else int(fill(0)[0].max()))
    # Pixels covered by fewer than R images repeat the first one with weight 0.
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
    """Return the geometry of images of a grid and rows of a panorama, for the kernels.

    Args:
        grid: Geometry of all images.
        faces: ``(n,)`` indices of the images.
        shape: ``(H, W)`` of the panorama.
        rows: Rows of the panorama, without a step.
        owner: ``(rows, W)`` owners; empty for feathering.
    """
    axes = grid.world_from_camera[faces]
    matrices = np.ascontiguousarray(grid.camera_matrix @ axes.transpose(0, 2, 1))
    columns, lines = sphere_rays(shape)
    spans = np.empty((0, 0, 2), np.int32) if owner.size else find_spans(grid, faces, shape, rows)
    return kernels.CanvasGeometry(faces, matrices, spans, columns, lines[rows], owner)


def find_spans(
    grid: PinholeGrid, faces: NDArray[np.int64], shape: tuple[int, int], rows: slice
) -> NDArray[np.int32]:
    """Return ``(n, rows, 2)`` spans, see `kernels.CanvasGeometry`.

    Args:
        grid: Geometry of all images.
        faces: ``(n,)`` indices of the images.
        shape: ``(H, W)`` of the panorama.
        rows: Rows of the panorama, without a step.
    """

    def build() -> tuple[NDArray[np.int32]]:
        spans = np.empty((len(faces), rows.stop - rows.start, 2), np.int32)
        matrices = grid.camera_matrix @ grid.world_from_camera[faces].transpose(0, 2, 1)
        u, v, w = matrices[:, None].transpose(2, 0, 1, 3)
        below, right = (side - 0.5 for side in grid.size)
        edges = np.concatenate([u + w / 2, right * w - u, v + w / 2, below * w - v], axis=1)
        lines = sphere_rays(shape)[1][rows]
        over_rows(write_spans, spans.shape[1], len(faces), edges, lines, shape[1], spans)
        return (spans,)

    key = "spans", shape, rows.start, rows.stop, *map(int, faces)
    return _cached(grid, key, build)[0]


@njit_exact
def _inside(normals: Array, x: float, y: float, z: float) -> bool:
    """Return True if a ray is on the inner side of all planes, with a tolerance for rounding."""
    inside = True
    for nx, ny, nz in normals:
        inside &= nx * x + ny * y + nz * z > -1e-6
    return inside


@njit_exact
def write_spans(start: int, stop: int, edges: Array, rows: Array, width: int, spans: Array) -> None:
    """Find the columns of ERP rows ``start:stop`` that images may cover.

    An image covers the directions between four planes through the center of the sphere. Its part of
    a row begins and ends where the row crosses one of the planes between the others.

    Args:
        start: First row.
        stop: One past the last row.
        edges: ``(n, 4, 3)`` normals of the planes, pointing inwards.
        rows: ``(H, 2)`` factors from `sphere_rays`.
        width: Number W of columns.
        spans: ``(n, H, 2)`` spans, see `kernels.CanvasGeometry`, written.
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
            # An image covers the longitude opposite to its middle only if it contains a pole.
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
    """Return tables as tensors, cached; on the CPU they share the memory of the arrays.

    Args:
        device: Device of the tables.
        grid: Geometry of the images.
        key: All other values that the tables depend on; None for tables that are not cached.
        build: Function that returns the arrays.
    """

    def tensors() -> tuple[Tensor, ...]:
        return tuple(torch.from_numpy(part).to(device) for part in build())

    return tensors() if key is None else _cached(grid, ("tensors", device, *key), tensors)
