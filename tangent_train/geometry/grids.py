"""Pinhole images around a common center: tangent images, cube faces, and rings of views."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, lru_cache
from numbers import Real
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError, at_least, check_type
from tangent_train.geometry.camera import half_width
from tangent_train.geometry.coverage import check_coverage, overlaps
from tangent_train.geometry.icosphere import icosphere, vertex_resolution
from tangent_train.geometry.sphere import MOST_ROWS, checked_rotation, lonlat_to_xyz, tangent_axes

Faces = Sequence[int] | NDArray[np.integer]
"""Indices of images."""

_AT_ONCE = 2**24
"""Number of products of directions and images that are held at once."""


class PinholeGrid:
    """N pinhole images of the same size and pitch around a common center.

    Pixel (row i, column j) of an image sits on the plane at distance 1 in front of the camera, at
    ``(j − (w−1)/2)·p`` to the right and ``(i − (h−1)/2)·q`` down. Every direction is *owned* by the
    image with the nearest center. Where the owners show all directions that they own, a direction
    lies at most half a pixel outside the outermost pixel centers of its owner.

    Args:
        axes: ``(N, 3, 3)`` camera axes before the rotation, as `world_from_camera`; all images have
            different centers.
        size: Rows h and columns w of the images.
        pitch: Distance p of neighboring pixels on the image plane, in focal lengths.
        rotation: ``(3, 3)`` proper rotation R of all images: directions become R·d.
        row_pitch: Distance q of neighboring rows; None for p, square pixels.
        is_overlapping: True if every direction is inside an image, not only on its outer edge.
        is_complete: True if the images are known to cover the area that is rendered back; False to
            check the coverage at that time.

    Raises:
        SettingError: The rotation is not a rotation, or the size is out of range.
    """

    def __init__(
        self,
        axes: NDArray[np.float64],
        size: tuple[int, int],
        pitch: float,
        rotation: ArrayLike | None = None,
        *,
        row_pitch: float | None = None,
        is_overlapping: bool = True,
        is_complete: bool = False,
    ) -> None:
        self._axes = axes
        self.size = _checked_size(size)
        self.pitch = pitch
        self.row_pitch = row_pitch or pitch
        self.rotation = None if rotation is None else checked_rotation(rotation)
        self.is_overlapping = is_overlapping
        self.is_complete = is_complete

    @property
    def num_images(self) -> int:
        """Number N of images."""
        return len(self._axes)

    @cached_property
    def neighbors(self) -> NDArray[np.int32]:
        """``(N, k)`` neighbors of every image, padded with the image itself.

        Stepping repeatedly to the neighbor with the nearest center ends at the owner.
        """
        return cell_neighbors(self._axes[..., 2])

    def with_rotation(self, rotation: ArrayLike | None) -> Self:
        """Return the same images under another rotation.

        Raises:
            SettingError: The matrix is not a rotation.
        """
        return self._changed(rotation=None if rotation is None else checked_rotation(rotation))

    def widened(self, margin: int) -> Self:
        """Return the same images with more pixels on every side, at the same pitch."""
        rows, columns = self.size
        size = rows + 2 * margin, columns + 2 * margin
        return self._changed(size=size, is_overlapping=self.is_overlapping or margin > 0)

    def resized(self, size: tuple[int, int]) -> Self:
        """Return the same images at another resolution: their outer edges agree.

        Use it for the output of a network that downsamples or upsamples images.

        Args:
            size: Rows h' and columns w'; the pitches become p·w/w' and q·h/h'.
        """
        row_pitch, pitch = (
            pitch * before / after
            for pitch, before, after in zip(self.pitches[::-1], self.size, size, strict=True)
        )
        return self._changed(size=size, pitch=pitch, row_pitch=row_pitch)

    def subset(self, faces: Faces) -> Self:
        """Return some of the images; the nearest among them owns a direction.

        Args:
            faces: Indices of one or more different images.
        """
        return self._changed(_axes=self._axes[self.face_indices(faces)])

    def _changed(self, **values: Any) -> Self:
        """Return this grid with other values, without its cached properties."""
        other = copy.copy(self)
        for name in ("neighbors", "world_from_camera", "_key"):
            vars(other).pop(name, None)
        vars(other).update(values)
        return other

    @property
    def dim(self) -> int:
        """Side d of square images in pixels."""
        return self.size[0]

    @property
    def pitches(self) -> tuple[float, float]:
        """Distances p of columns and q of rows on the image plane, in focal lengths."""
        return self.pitch, self.row_pitch

    @property
    def half_size(self) -> tuple[float, float]:
        """Positions x and y of the outer pixel edges on the image plane."""
        rows, columns = self.size
        return columns * self.pitch / 2, rows * self.row_pitch / 2

    @property
    def half_extent(self) -> float:
        """Half extent h = (d−1)/2·p: position of the outermost pixel centers on the image plane."""
        return (self.dim - 1) / 2 * self.pitch

    @property
    def fov_deg(self) -> float:
        """Angle between adjacent corners in degrees: acos(1 / (1 + 2h²)) (paper, table of FOV)."""
        return math.degrees(math.acos(1 / (1 + 2 * self.half_extent**2)))

    @property
    def width_deg(self) -> float:
        """Angle across the middle of an image, between its outer pixel edges, in degrees."""
        return math.degrees(2 * math.atan(self.half_size[0]))

    @property
    def camera_matrix(self) -> NDArray[np.float64]:
        """``(3, 3)`` pinhole matrix of every image: focal lengths 1/p, 1/q, center (w−1)/2, …."""
        y, x = ((side - 1) / 2 for side in self.size)
        return np.array([[1 / self.pitch, 0, x], [0, 1 / self.row_pitch, y], [0, 0, 1]])

    @property
    def centers_xyz(self) -> NDArray[np.float64]:
        """``(N, 3)`` directions of the images' centers."""
        return self.world_from_camera[..., 2]

    @cached_property
    def world_from_camera(self) -> NDArray[np.float64]:
        """``(N, 3, 3)`` camera axes (x right, y down, z forward) as columns, read-only.

        The determinant is −1, because the frame of the sphere is left-handed, see
        `to_right_handed`.
        """
        axes = self._axes.copy() if self.rotation is None else self.rotation @ self._axes
        axes.setflags(write=False)
        return axes

    def directions(self, faces: Faces | None = None) -> NDArray[np.float64]:
        """Return directions of the pixel centers.

        Args:
            faces: Images to return, by default all.

        Returns:
            ``(n, h, w, 3)`` unit vectors.
        """
        rows, columns = (
            (np.arange(side) - (side - 1) / 2) * pitch
            for side, pitch in zip(self.size, self.pitches[::-1], strict=True)
        )
        x, y = np.meshgrid(columns, rows)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        axes = self.world_from_camera[self.face_indices(faces)]
        return np.einsum("nwc,ijc->nijw", axes, rays)

    def face_indices(self, faces: Faces | None = None) -> NDArray[np.int64]:
        """Return indices of images, by default of all.

        Raises:
            SettingError: There is no such image.
            TypeError: It is not a list.
        """
        every = np.arange(self.num_images)
        if faces is None:
            return every
        check_type("faces", faces, Iterable, "a list of indices, e.g. [0, 5]")
        try:
            return every[[*faces]]
        except IndexError as error:
            expected = f"indices of images, 0 to {self.num_images - 1}"
            raise SettingError("faces", found=faces, expected=expected) from error

    def owners(self, directions_xyz: ArrayLike) -> NDArray[np.int64]:
        """Return the face that owns each direction: the face with the nearest center.

        Args:
            directions_xyz: ``(..., 3)`` vectors of any length.

        Returns:
            ``(...)`` face indices.
        """
        directions = np.asarray(directions_xyz, np.float64)
        flat = directions.reshape(-1, 3)
        parts = np.array_split(flat, 1 + len(flat) * self.num_images // _AT_ONCE)
        owner = np.concatenate([(part @ self.centers_xyz.T).argmax(axis=1) for part in parts])
        return owner.reshape(directions.shape[:-1])

    def project(self, directions_xyz: ArrayLike, faces: ArrayLike) -> NDArray[np.float64]:
        """Return pixel positions of directions in given images.

        Args:
            directions_xyz: ``(..., 3)`` vectors of any length.
            faces: Face of each direction, broadcast against ``(...)``.

        Returns:
            ``(..., 2)`` column and row; NaN where the direction is behind the image.
        """
        axes = self.world_from_camera[np.asarray(faces)]
        points = np.einsum("...w,...wc->...c", np.asarray(directions_xyz, np.float64), axes)
        depth = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        return points[..., :2] / depth / self.pitches + self.camera_matrix[:2, 2]

    def insets(self, directions_xyz: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return the distances of directions from the edges of the images.

        Args:
            directions_xyz: ``(n, 3)`` unit vectors.

        Returns:
            ``(N, n)`` sines of the angles from the nearest outer edges; negative outside an image.
        """
        across, down = self.half_size
        sections = 1 + len(directions_xyz) * self.num_images // _AT_ONCE
        insets = []
        for axes in np.array_split(self.world_from_camera, sections):
            x, y, z = np.moveaxis(directions_xyz @ axes, -1, 0)
            beside = (across * z - np.abs(x)) / math.hypot(1, across)
            above = (down * z - np.abs(y)) / math.hypot(1, down)
            insets.append(np.minimum(beside, above).astype(np.float32))
        return np.concatenate(insets)

    @cached_property
    def _key(self) -> tuple[object, ...]:
        rotation = None if self.rotation is None else self.rotation.tobytes()
        return self._axes.tobytes(), self.size, self.pitches, rotation, self.is_overlapping

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PinholeGrid) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


class TangentGrid(PinholeGrid):
    """N = 20·4^b pinhole images tangent to the faces of a level-b icosahedron.

    Pixel (row i, column j) of an image sits on its tangent plane at ``x = (j − (d−1)/2)·p`` to the
    east and ``y = −(i − (d−1)/2)·p`` to the north of the face's center, with the pitch
    ``p = R_v(b−1) / 2^(s−b)`` (paper, equations for d and for the tangent bounds): planar gnomonic
    coordinates. Every direction is *owned* by the face with the nearest center.

    Args:
        base_level: Base level b.
        level: Level s of the panorama, at least b.
        dim: Side d in pixels, default 2^(s−b). It changes the extent of the images and keeps the
            pitch: a smaller side crops towards the owned cell, a larger one adds a margin.
        rotation: ``(3, 3)`` proper rotation R of the whole icosahedron: directions become R·d.

    Raises:
        SettingError: The rotation is not a rotation, a level is out of range, or `dim` would leave
            part of an owned cell uncovered.

    >>> grid = TangentGrid(base_level=1, level=10)
    >>> grid.num_images, grid.dim, round(grid.fov_deg, 4)
    (80, 512, 51.6162)
    """

    def __init__(
        self,
        base_level: int,
        level: int,
        dim: int | None = None,
        rotation: ArrayLike | None = None,
    ) -> None:
        at_least("base_level", base_level, 0, 8)
        at_least("level", level, 0)
        dim = int(2.0 ** (level - base_level)) if dim is None else dim
        least = self.least_dim(base_level, level)
        if at_least("dim", dim, 0) < least:
            raise SettingError(
                "dim",
                found=dim,
                expected=f"at least {least} at base level {base_level} and level {level}",
                remedy="Smaller images would leave parts of the sphere uncovered.",
            )
        axes, pitch = _face_axes(base_level), _pitch(base_level, level)
        super().__init__(axes, (dim, dim), pitch, rotation, is_complete=True)
        self.base_level = base_level
        self.level = level

    @staticmethod
    def least_dim(base_level: int, level: int) -> int:
        """Return the smallest `dim` whose images cover every owned cell."""
        return math.ceil(2 * _owned_extent(base_level) / _pitch(base_level, level) - 1e-9) + 1


@lru_cache(maxsize=16)
def _face_axes(base_level: int) -> NDArray[np.float64]:
    """Return the camera axes ``(N, 3, 3)`` of the faces; north is up."""
    vertices, faces = icosphere(base_level)
    return _upright_axes(vertices[faces].mean(axis=1))


@lru_cache(maxsize=16)
def _owned_extent(base_level: int) -> float:
    """Return the largest |x| or |y| on its tangent plane of the points that a face owns."""
    from scipy.spatial import ConvexHull  # slow to import

    axes = _face_axes(base_level)
    # The normals of the hull of the centers are the corners at which the cells of faces meet.
    hull = ConvexHull(axes[..., 2])
    points = np.einsum("ni,nfic->nfc", hull.equations[:, :3], axes[hull.simplices])
    return float(np.abs(points[..., :2] / points[..., 2:]).max())


def _pitch(base_level: int, level: int) -> float:
    return vertex_resolution(base_level - 1) / 2.0 ** (level - base_level)


def _upright_axes(centers_xyz: ArrayLike) -> NDArray[np.float64]:
    """Return the camera axes ``(N, 3, 3)`` of images around some centers, in which north is up."""
    east, north, forward = np.moveaxis(tangent_axes(centers_xyz), -2, 0)
    return np.stack([east, -north, forward], axis=-1)


class CubeGrid(PinholeGrid):
    """The six faces of a cube around the center, pinhole images of 90°, or more with a margin.

    The faces are in this order: front (+x, the middle of the panorama), right (+y), back (−x),
    left (−y), up (+z) and down (−z). The first four stand upright. Up and down are the front
    camera tilted up and down: columns grow to +y in both, rows towards the front (+x) in up and
    towards the back (−x) in down, so that up fits above and down below the front, as in a cross of
    unfolded faces.

    The outer *edges* of neighboring images meet: d pixels span the 90°, the pitch is ``p = 2/d``
    and the outermost pixel centers are half a pixel inside. The images do not overlap; the
    directions that a face owns reach half a pixel beyond its outermost pixel centers. With a
    margin m on every side, d − 2m pixels span the 90°, and the images overlap.
    `fov_deg`, between pixel centers as everywhere, is a little less than the 70.5° between adjacent
    corners of the cube.

    Args:
        dim: Side d in pixels, 2 or more; 2^s is 90° of a panorama of level s.
        rotation: ``(3, 3)`` proper rotation R of the whole cube: directions become R·d.
        margin: Pixels beyond the 90° on every side.

    Raises:
        SettingError: The side is too small, or the rotation is not a rotation.

    >>> grid = CubeGrid(dim=32)
    >>> grid.num_images, grid.pitch, grid.half_extent
    (6, 0.0625, 0.96875)
    """

    def __init__(self, dim: int, rotation: ArrayLike | None = None, margin: int = 0) -> None:
        dim = at_least("dim", dim, 2 + 2 * at_least("margin", margin, 0))
        x, y, z = np.eye(3)
        axes = _upright_axes([x, y, -x, -y, z, -z])
        pitch = 2 / (dim - 2 * margin)
        # Without a margin, neighbors meet at their outer edges.
        kinds = {"is_overlapping": margin > 0, "is_complete": True}
        super().__init__(axes, (dim, dim), pitch, rotation, **kinds)


class RingGrid(PinholeGrid):
    """Horizontal views in rings: cameras that are yawed and pitched, but not rolled.

    The images are in the order of the rings, within a ring by growing longitude. In the middle
    column of an image, the vertical is up; a view at pitch ±90° is the view at pitch 0 tilted up
    or down.

    Args:
        rings: Rings, each with ``pitch`` in degrees (−90 to 90) and its number of ``views``.
        fov_deg: Least horizontal and vertical field of view in degrees, between the outer pixel
            edges.
        size: Rows and columns of the images.
        rotation: ``(3, 3)`` proper rotation R of all images: directions become R·d.
        valid: ``(H, W)`` pixels of a panorama that the images must cover; None for the sphere.
        square_pixels: True for square pixels: if `size` has another ratio, one field of view is
            larger. False for exactly that field of view, stretched to `size`.
        by_owners: False if images may be blended with ``feather`` only, see `check_coverage`.
        is_complete: False for images that do not cover these pixels without other grids.

    Raises:
        SettingError: A field of view is out of range, or the images miss a direction.

    >>> grid = RingGrid([{"pitch": 0, "views": 4}, {"pitch": 90, "views": 1},
    ...                  {"pitch": -90, "views": 1}], (100, 100), (32, 32))
    >>> grid.num_images, grid.is_overlapping
    (6, True)
    """

    def __init__(
        self,
        rings: Sequence[Mapping[str, float]],
        fov_deg: tuple[float, float],
        size: tuple[int, int],
        rotation: ArrayLike | None = None,
        valid: NDArray[np.bool_] | None = None,
        *,
        square_pixels: bool = True,
        by_owners: bool = True,
        is_complete: bool = True,
    ) -> None:
        across, down = map(half_width, _pair("fov_deg", fov_deg))
        rows, columns = _checked_size(size)
        pitches = 2 * across / columns, 2 * down / rows
        pitch, row_pitch = (max(pitches),) * 2 if square_pixels else pitches
        axes = _upright_axes(lonlat_to_xyz(np.radians(_ring_centers(rings))))
        kinds: Any = {"row_pitch": row_pitch, "is_complete": is_complete}
        super().__init__(axes, (rows, columns), pitch, rotation, **kinds)
        resting = self.with_rotation(None)
        check_type("valid", valid, (np.ndarray, type(None)), "an array of booleans")
        if is_complete:
            check_coverage([resting], valid, by_owners=by_owners)
            self.is_overlapping = overlaps(resting, valid)


def _ring_centers(rings: Any) -> list[tuple[float, float]]:
    """Return longitudes and latitudes of the centers of views in rings, in degrees."""
    check_type("rings", rings, Sequence, "a list of rings")
    at_least("number of rings", len(rings), 1)
    centers: list[tuple[float, float]] = []
    for ring in rings:
        check_type("ring", ring, Mapping, "its pitch and views, e.g. {'pitch': 0, 'views': 8}")
        check_type("pitch", ring.get("pitch"), Real, "degrees")
        views = at_least("views", ring.get("views"), 1)
        centers += [(360 / views * number, ring["pitch"]) for number in range(views)]
    return centers


def _checked_size(size: Any) -> tuple[int, int]:
    sides = zip(("rows", "columns"), _pair("size", size), strict=True)
    rows, columns = (at_least(f"{name} of an image", side, 1, MOST_ROWS) for name, side in sides)
    return rows, columns


def _pair(name: str, value: Any) -> tuple[Any, Any]:
    if np.shape(value) != (2,):
        raise SettingError(name, found=repr(value), expected="two numbers")
    return value[0], value[1]


def cell_neighbors(centers_xyz: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the neighbors of every cell.

    They are the edges of the convex hull of the centers. A linear function that is not the largest
    at a corner of a convex body increases along one of its edges, so stepping repeatedly to the
    neighbor with the nearest center ends at the nearest one. If the centers lie in a plane, or two
    are equal, all others are neighbors.

    Args:
        centers_xyz: ``(N, 3)`` unit vectors.

    Returns:
        ``(N, k)`` indices, padded with the cell itself.
    """
    from scipy.spatial import ConvexHull, QhullError  # slow to import

    count = len(centers_xyz)
    sides = np.empty((0, 2), np.int64)
    with suppress(QhullError, ValueError):  # centers in a plane
        triangles = ConvexHull(centers_xyz).simplices
        sides = triangles[:, [[0, 1], [1, 2], [2, 0], [1, 0], [2, 1], [0, 2]]].reshape(-1, 2)
    if len(np.unique(sides)) < count:
        sides = np.argwhere(~np.eye(count, dtype=np.bool_))
    cells, others = np.unique(sides, axis=0).T
    number = np.arange(len(cells)) - np.searchsorted(cells, cells)
    neighbors = np.repeat(np.arange(count)[:, None], 1 + number.max(initial=0), axis=1)
    neighbors[cells, number] = others
    return neighbors.astype(np.int32)
