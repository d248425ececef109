"""Tables of positions per grid and panorama size, in a cache of limited size.

The ray of pixel (i, j) of a panorama or image is
``(rows[i, 0] columns[0, j], rows[i, 0] columns[1, j], rows[i, 1])``, with the factors of
`sphere_rays` or `plane_rays`.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import lru_cache
from os import register_at_fork
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import PinholeGrid, equirect_latitudes, equirect_longitudes
from tangent_train.rendering import kernels
from tangent_train.rendering.kernels import Array, njit_exact, over_rows

if TYPE_CHECKING:
    import torch

Value = TypeVar("Value", bound=tuple[Any, ...])
Rays = tuple[Array, Array]
"""``(2, W)`` factors of the columns and ``(H, 2)`` factors of the rows, float64."""


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
                self._tables[key] = table
                self.nbytes += size
                while self.nbytes > self.limit:
                    self.nbytes -= _nbytes(self._tables.popitem(last=False)[1])
        return table

    def _new_lock(self) -> None:
        """Replace the lock in a forked process: it may have been locked by another thread."""
        self._lock = Lock()


def _nbytes(table: tuple[Any, ...]) -> int:
    return sum(part.nbytes for part in table)


TABLES = TableCache(limit=2**30)
"""At level 10 and base level 1 the tables take 168 MB from panorama to images."""

_ROTATED = TableCache(limit=2**26)
"""Tables of rotated grids, reused for depth and labels after RGB. They have a separate cache,
because random rotations would evict all other tables."""

_DEVICE_SHARE = 8
"""Tables on a GPU take at most an eighth of its memory."""


@lru_cache
def _tables_on(device: torch.device) -> TableCache:
    """Return the cache of tables on a device other than the CPU."""
    import torch

    if device.type == "cuda" and torch.cuda.is_available():
        return TableCache(torch.cuda.get_device_properties(device).total_memory // _DEVICE_SHARE)
    return TableCache(TABLES.limit)


def cached(
    key: Hashable,
    build: Callable[[], Value],
    *,
    is_rotated: bool = False,
    device: torch.device | None = None,
) -> Value:
    """Return the table of a key from the cache of its device, see `TableCache.get`."""
    if device is not None and device.type != "cpu":
        return _tables_on(device).get(key, build)
    return (_ROTATED if is_rotated else TABLES).get(key, build)


def _cached(grid: PinholeGrid, key: tuple[Hashable, ...], build: Callable[[], Value]) -> Value:
    return cached((grid, *key), build, is_rotated=grid.rotation is not None)


def forward_map(
    grid: PinholeGrid,
    shape: tuple[int, int],
    faces: NDArray[np.int64],
    dtype: np.dtype[np.floating],
) -> EquirectMap:
    """Return positions in the ERP of the pixels of tangent images, stacked vertically.

    Args:
        grid: Geometry of the images.
        shape: ``(H, W)`` of the ERP.
        faces: Indices of the images.
        dtype: float32 or float64; the computation is float64 in both cases.
    """

    def build() -> EquirectMap:
        return EquirectMap.of(*positions_of_pixels(grid, shape, faces, dtype), shape)

    return _cached(grid, ("forward", shape, tuple(faces.tolist()), dtype), build)


def positions_of_pixels(
    grid: PinholeGrid,
    shape: tuple[int, int],
    faces: NDArray[np.int64],
    dtype: np.dtype[np.floating],
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return positions in an ERP of the pixels of images, see `positions_of_rays`."""
    world_from_pixel = grid.world_from_camera[faces] @ np.linalg.inv(grid.camera_matrix)
    return positions_of_rays(world_from_pixel[..., [0, 2, 1]], plane_rays(grid.size), shape, dtype)


def owners(grid: PinholeGrid, shape: tuple[int, int]) -> NDArray[np.integer]:
    """Return the owner of every ERP pixel, ``(H, W)``, in the smallest integer dtype that fits."""

    def build() -> tuple[NDArray[np.integer]]:
        kinds = (np.uint8, np.int16, np.int32)
        face = np.empty(shape, next(k for k in kinds if grid.num_images <= np.iinfo(k).max + 1))
        centers = np.ascontiguousarray(grid.centers_xyz)
        rays = sphere_rays(shape)
        mesh = (centers, grid.neighbors, _inner_cosine(grid))
        over_rows(_write_owners, *shape, *mesh, *rays, face)
        return (face,)

    return _cached(grid, ("owners", shape), build)[0]


def _inner_cosine(grid: PinholeGrid) -> float:
    """Return the cosine of half the smallest angle between two centers."""
    centers, around = grid.centers_xyz, grid.neighbors
    cosines = np.einsum("nkc,nc->nk", centers[around], centers)
    others = around != np.arange(grid.num_images)[:, None]
    return float(np.cos(np.arccos(cosines[others].max(initial=-1.0)) / 2))


@njit_exact
def _write_owners(
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


def nearest_pixels(grid: PinholeGrid, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Return the nearest pixel of the owner of every ERP pixel.

    Half-way between two pixels, the even one is taken.

    Args:
        grid: Geometry of the images.
        shape: ``(H, W)`` of the ERP.

    Returns:
        ``(H, W)`` flat indices into images ``(N, h, w)``.
    """
    index = np.empty(shape, np.int64)
    geometry = canvas_geometry(grid, grid.face_indices(), shape, owners(grid, shape))
    arguments = geometry.matrices, geometry.columns, geometry.rows, geometry.owner
    over_rows(_write_nearest_pixels, *shape, *arguments, grid.size, index)
    return index


@njit_exact
def _write_nearest_pixels(
    start: int, stop: int, matrices: Array, columns: Array, rows: Array, owner: Array,
    size: tuple[int, int], index: Array,
) -> None:  # fmt: skip
    """Write `nearest_pixels` of the ERP rows ``start:stop``."""
    for i in range(start, stop):
        z = rows[i, 1]
        for j in range(columns.shape[1]):
            m, x, y = matrices[owner[i, j]], rows[i, 0] * columns[0, j], rows[i, 0] * columns[1, j]
            w = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
            u = np.float32((m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) / w)
            v = np.float32((m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) / w)
            row: Any = min(max(np.int64(np.rint(v)), 0), size[0] - 1)
            column: Any = min(max(np.int64(np.rint(u)), 0), size[1] - 1)
            index[i, j] = (np.int64(owner[i, j]) * size[0] + row) * size[1] + column


def canvas_geometry(
    grid: PinholeGrid,
    faces: NDArray[np.int64],
    shape: tuple[int, int],
    owner: NDArray[np.integer] | None,
) -> kernels.CanvasGeometry:
    """Return the geometry of images of a grid and a panorama, for the kernels.

    Args:
        grid: Geometry of all images.
        faces: ``(n,)`` indices of the images.
        shape: ``(H, W)`` of the panorama.
        owner: ``(H, W)`` owners; None for feathering.
    """
    axes = grid.world_from_camera[faces]
    matrices = np.ascontiguousarray(grid.camera_matrix @ axes.transpose(0, 2, 1))
    rays = sphere_rays(shape)
    if owner is not None:
        return kernels.CanvasGeometry(faces, matrices, kernels.NO_SPANS, *rays, owner)
    spans = _covered_spans(grid, faces, shape)
    return kernels.CanvasGeometry(faces, matrices, spans, *rays, kernels.NO_OWNERS)


def _covered_spans(
    grid: PinholeGrid, faces: NDArray[np.int64], shape: tuple[int, int]
) -> NDArray[np.int32]:
    """Return ``(n, H, 2)`` spans, see `kernels.CanvasGeometry`.

    Args:
        grid: Geometry of all images.
        faces: ``(n,)`` indices of the images.
        shape: ``(H, W)`` of the panorama.
    """

    def build() -> tuple[NDArray[np.int32]]:
        spans = np.empty((len(faces), shape[0], 2), np.int32)
        matrices = grid.camera_matrix @ grid.world_from_camera[faces].transpose(0, 2, 1)
        u, v, w = matrices[:, None].transpose(2, 0, 1, 3)
        below, right = (side - 0.5 for side in grid.size)
        edges = np.concatenate([u + w / 2, right * w - u, v + w / 2, below * w - v], axis=1)
        over_rows(_write_spans, shape[0], len(faces), edges, sphere_rays(shape)[1], shape[1], spans)
        return (spans,)

    return _cached(grid, ("spans", shape, tuple(faces.tolist())), build)[0]


@njit_exact
def _inside(normals: Array, x: float, y: float, z: float) -> bool:
    """Return True if a ray is on the inner side of all planes, with a tolerance for rounding."""
    inside = True
    for nx, ny, nz in normals:
        inside &= nx * x + ny * y + nz * z > -1e-6
    return inside


@njit_exact
def _write_spans(
    start: int, stop: int, edges: Array, rows: Array, width: int, spans: Array
) -> None:
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


def sphere_rays(shape: tuple[int, int]) -> Rays:
    """Return the rays of a panorama, unit directions: cos λ, sin λ and cos φ, sin φ."""
    lat, lon = equirect_latitudes(shape[0]), equirect_longitudes(shape[1])
    return np.stack([np.cos(lon), np.sin(lon)]), np.stack([np.cos(lat), np.sin(lat)], -1)


def plane_rays(shape: tuple[int, int]) -> Rays:
    """Return the rays ``(j, 1, i)`` of an image: homogeneous pixels in another order."""
    height, width = shape
    columns = np.stack([np.arange(width, dtype=np.float64), np.ones(width)])
    return columns, np.stack([np.ones(height), np.arange(height, dtype=np.float64)], -1)


def map_dtype(exact: bool, interpolation: str) -> np.dtype[np.floating]:
    """Return the dtype of positions: float64 if `exact` and bilinear, else float32.

    Nearest sampling uses the same positions for all dtypes.
    """
    return np.dtype(np.float64 if exact and interpolation == "bilinear" else np.float32)


class EquirectMap(NamedTuple):
    """Positions in an ERP, relative to the part of it that contains them.

    Attributes:
        u: ``(h, w)`` columns in the part, float32 or float64.
        v: ``(h, w)`` rows in the part, same dtype.
        polar: Flat indices of positions between a pole and the row next to it.
        part: First row, row after the last, first column and column after the last, int64. Columns
            W and higher are beyond the seam.
    """

    u: NDArray[np.floating]
    v: NDArray[np.floating]
    polar: NDArray[np.intp]
    part: NDArray[np.int64]

    @classmethod
    def of(
        cls, u: NDArray[np.floating], v: NDArray[np.floating], shape: tuple[int, int]
    ) -> EquirectMap:
        """Find the part that contains some positions.

        Args:
            u: ``(h, w)`` columns in [−½, W − ½], float32 or float64.
            v: ``(h, w)`` rows in [−½, H − ½], same dtype.
            shape: ``(H, W)`` of the ERP.
        """
        height, width = shape
        polar = np.flatnonzero((v < 0) | (v > height - 1))
        # Columns of the left half are rounded as if beyond the seam, so that all parts agree.
        beyond, left_half = u + u.dtype.type(width), u < width / 2
        u = np.where(left_half, beyond - u.dtype.type(width), u)
        # An even offset keeps the choice between two equally near pixels, which is the even one.
        top, left = (int(line.min()) // 2 * 2 for line in (v, u))
        bottom, right = min(height, int(v.max()) + 2), int(u.max()) + 2
        if u.min() < 0 or right - left > width / 2:
            joined = np.where(left_half, beyond, u)
            left, right = int(joined.min()) // 2 * 2, int(joined.max()) + 2
            if right - left > width / 2:
                left, right = 0, width
            else:
                u = joined
        part = np.array((top, bottom, left, right))
        return cls(u - u.dtype.type(left), v - u.dtype.type(top), polar, part)


def positions_of_rays(
    matrices: NDArray[np.float64],
    rays: Rays,
    shape: tuple[int, int],
    dtype: np.dtype[np.floating],
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return the positions in an ERP of the rays of n canvases, stacked vertically.

    Args:
        matrices: ``(n, 3, 3)`` from the rays of each canvas to directions of any length.
        rays: Rays of a canvas of ``(h, w)`` pixels.
        shape: ``(H, W)`` of the ERP.
        dtype: float32 or float64; the computation is float64 in both cases.

    Returns:
        Columns in [−½, W − ½] and rows in [−½, H − ½], ``(n h, w)``.
    """
    columns, rows = rays
    u, v = np.empty((2, len(matrices) * len(rows), columns.shape[1]), dtype)
    over_rows(_write_positions, *u.shape, np.ascontiguousarray(matrices), *rays, *shape, u, v)
    return u, v


@njit_exact
def _write_positions(
    start: int, stop: int, matrices: Array, columns: Array, rows: Array,
    height: int, width: int, u: Array, v: Array,
) -> None:  # fmt: skip
    """Write ERP positions of the rays of stacked canvases, rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        matrices: ``(n, 3, 3)`` from each canvas's rays to directions of any length.
        columns: ``(2, w)`` factors of the rays.
        rows: ``(h, 2)`` factors of the rays.
        height: Rows H of the ERP.
        width: Columns W of the ERP.
        u: ``(n h, w)`` columns in the ERP, written.
        v: ``(n h, w)`` rows in the ERP, written.
    """
    for row in range(start, stop):
        m = matrices[row // len(rows)]
        i = row % len(rows)
        c = rows[i, 1]
        for j in range(columns.shape[1]):
            a, b = rows[i, 0] * columns[0, j], rows[i, 0] * columns[1, j]
            x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
            y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c
            z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
            u[row, j] = (math.atan2(y, x) / (2 * math.pi) + 0.5) * width - 0.5
            v[row, j] = (0.5 - math.atan2(z, math.sqrt(x * x + y * y)) / math.pi) * height - 0.5
