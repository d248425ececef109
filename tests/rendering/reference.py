"""A slow float64 reference for tangent images (paper, section 3.2) and horizontal views.

It shares no code with the library, which is tested against it. The mesh comes from trimesh. Instead
of camera matrices it uses longitude, latitude and the textbook formulas of the gnomonic projection
(Snyder 1987, chapter 22). Faces are in another order: `ReferenceGrid.order` matches their centers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]


def subdivided_icosahedron(level: int) -> trimesh.Trimesh:
    """S(b), by trimesh's Loop subdivision; the vertices of the icosahedron include the poles."""
    ring = math.atan(0.5)
    lonlat = [(0.0, math.pi / 2), (0.0, -math.pi / 2)]
    lonlat += [(math.radians(72 * k), ring) for k in range(5)]
    lonlat += [(math.radians(72 * k + 36), -ring) for k in range(5)]
    vertices = to_xyz(np.array(lonlat))
    faces = ConvexHull(vertices).simplices
    mesh = trimesh.remesh.subdivide_loop(vertices, faces, level)
    return trimesh.Trimesh(*mesh, process=False)


def vertex_resolution(level: int) -> float:
    """R_v(b), in radians."""
    if level == -1:
        return 2 * vertex_resolution(0)
    mesh = subdivided_icosahedron(level)
    units = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    means = []
    for unit, joined in zip(units, mesh.vertex_neighbors, strict=True):
        means.append(np.arccos(units[joined] @ unit).mean())
    return float(np.mean(means))


def to_xyz(lonlat: Array) -> Array:
    """x = cos φ cos λ, y = cos φ sin λ, z = sin φ."""
    lon, lat = lonlat[..., 0], lonlat[..., 1]
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def to_lonlat(xyz: Array) -> Array:
    """Inverse of `to_xyz`; asin(z) would lose half the digits at the poles."""
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1)


def panorama_lonlat(shape: tuple[int, int]) -> Array:
    """``(H, W, 2)`` of the pixel centers."""
    height, width = shape
    result = np.empty((height, width, 2))
    for row in range(height):
        result[row, :, 1] = math.pi / 2 - (row + 0.5) / height * math.pi
    for column in range(width):
        result[:, column, 0] = (column + 0.5) / width * 2 * math.pi - math.pi
    return result


def panorama_position(lonlat: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Row and column, pixel centers at integers."""
    height, width = shape
    row = (math.pi / 2 - lonlat[..., 1]) / math.pi * height - 0.5
    return row, (lonlat[..., 0] + math.pi) / (2 * math.pi) * width - 0.5


def panorama_row(image: Array, row: NDArray[np.int64], column: Array) -> Array:
    """Interpolate linearly along a row. A row beyond a pole continues half a revolution further.

    For an odd width its pixels are the means of the two columns that are nearest.
    """
    height, width = image.shape[:2]
    beyond = ((row < 0) | (row >= height))[..., None]
    row = np.where(row < 0, -1 - row, np.where(row >= height, 2 * height - 1 - row, row))
    left = np.floor(column).astype(int)
    right = (column - left)[..., None]

    def pixel(column: NDArray[np.int64]) -> Array:
        far = [image[row, (column + half) % width] for half in (width // 2, (width + 1) // 2)]
        return np.where(beyond, sum(far) / 2, image[row, column % width])

    return np.asarray((1 - right) * pixel(left) + right * pixel(left + 1))


def sample_panorama(image: Array, lonlat: Array, interpolation: str) -> Array:
    """Sample ``(H, W, C)`` at ``(..., 2)``; returns ``(..., C)``."""
    height, width = image.shape[:2]
    row, column = panorama_position(lonlat, (height, width))
    if interpolation == "nearest":
        nearest = np.clip(np.floor(row + 0.5), 0, height - 1).astype(int)
        return image[nearest, np.floor(column + 0.5).astype(int) % width]
    top = np.floor(row).astype(int)
    down = (row - top)[..., None]
    above, below = panorama_row(image, top, column), panorama_row(image, top + 1, column)
    return np.asarray((1 - down) * above + down * below)


def sample_images(images: Array, face: NDArray[np.int64], row: Array, column: Array) -> Array:
    """Sample ``(N, h, w, C)`` bilinearly, clamped to the outermost pixel centers."""
    height, width = images.shape[1:3]
    row, column = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
    top = np.minimum(np.floor(row), height - 2).astype(int)
    left = np.minimum(np.floor(column), width - 2).astype(int)
    down, right = (row - top)[..., None], (column - left)[..., None]
    above = (1 - right) * images[face, top, left] + right * images[face, top, left + 1]
    top = top + 1
    below = (1 - right) * images[face, top, left] + right * images[face, top, left + 1]
    return np.asarray((1 - down) * above + down * below)


@dataclass(frozen=True)
class ReferenceGrid:
    """All pinhole images of a panorama, each with north up before `rotation` rotates all."""

    centers_lonlat: Array
    pitch: float
    size: tuple[int, int]
    rotation: Array = field(default_factory=lambda: np.eye(3))

    @classmethod
    def tangent(cls, base_level: int, level: int, dim: int, rotation: Array) -> ReferenceGrid:
        """Images around the barycenters of the faces of the icosahedron.

        The pitch is the paper's half extent (d−1)/(2d)·R_v(b−1) of the default d over its (d−1)/2
        pixels.
        """
        centers = subdivided_icosahedron(base_level).triangles_center
        centers = to_lonlat(centers / np.linalg.norm(centers, axis=1, keepdims=True))
        pitch = vertex_resolution(base_level - 1) / 2 ** (level - base_level)
        return cls(centers, pitch, (dim, dim), rotation)

    def order(self, centers_xyz: ArrayLike) -> NDArray[np.int64]:
        """Return the face of this grid for each center."""
        centers = to_xyz(self.centers_lonlat) @ self.rotation.T
        closeness = np.asarray(centers_xyz) @ centers.T
        order = closeness.argmax(axis=1)
        if closeness.max(axis=1).min() < 1 - 1e-12 or len(set(order.tolist())) != len(centers):
            raise AssertionError("the centers of the faces differ")
        return order

    def lonlat(self, face: int) -> Array:
        """``(h, w, 2)`` where the pixels of an image are on the sphere: inverse gnomonic."""
        lon_0, lat_0 = self.centers_lonlat[face]
        down, right = ((np.arange(n) - (n - 1) / 2) * self.pitch for n in self.size)
        x, y = np.meshgrid(right, -down)
        rho = np.maximum(np.hypot(x, y), 1e-300)
        c = np.arctan(rho)
        lat = np.arcsin(np.cos(c) * np.sin(lat_0) + y * np.sin(c) * np.cos(lat_0) / rho)
        lon = lon_0 + np.arctan2(
            x * np.sin(c), rho * np.cos(lat_0) * np.cos(c) - y * np.sin(lat_0) * np.sin(c)
        )
        return to_lonlat(to_xyz(np.stack([lon, lat], axis=-1)) @ self.rotation.T)

    def forward(self, image: Array, interpolation: str = "bilinear") -> Array:
        """``(H, W, C)`` -> ``(N, h, w, C)``."""
        faces = range(len(self.centers_lonlat))
        return np.stack([sample_panorama(image, self.lonlat(f), interpolation) for f in faces])

    def nearness(self, shape: tuple[int, int]) -> Array:
        """``(H, W, N)`` cosine of the angle from every panorama pixel to every center."""
        return self._resting(shape) @ to_xyz(self.centers_lonlat).T

    def _resting(self, shape: tuple[int, int]) -> Array:
        return np.asarray(to_xyz(panorama_lonlat(shape)) @ self.rotation)

    def positions(self, shape: tuple[int, int], face: NDArray[np.int64]) -> tuple[Array, Array]:
        """Row and column of every panorama pixel in the image of a face: gnomonic projection."""
        lonlat = to_lonlat(self._resting(shape))
        lon, lat = lonlat[..., 0], lonlat[..., 1]
        lon_0, lat_0 = self.centers_lonlat[face, 0], self.centers_lonlat[face, 1]
        cosine = np.cos(lon - lon_0)
        cos_c = np.sin(lat_0) * np.sin(lat) + np.cos(lat_0) * np.cos(lat) * cosine
        x = np.cos(lat) * np.sin(lon - lon_0) / cos_c
        y = (np.cos(lat_0) * np.sin(lat) - np.sin(lat_0) * np.cos(lat) * cosine) / cos_c
        row, column = ((n - 1) / 2 for n in self.size)
        return row - y / self.pitch, column + x / self.pitch

    def backward(self, images: Array, shape: tuple[int, int]) -> Array:
        """``(N, h, w, C)`` -> ``(H, W, C)`` from the image with the nearest center."""
        owner = self.nearness(shape).argmax(axis=-1)
        return sample_images(images, owner, *self.positions(shape, owner))

    def feathered(self, images: Array, shape: tuple[int, int]) -> Array:
        """Mean of all images that see a pixel, weights ((1 − a²)(1 − b²))⁴.

        a and b are the offsets from the middle in half sides, so that the weight falls to 0 at
        the outer edges of the outermost pixels.
        """
        total = np.zeros((*shape, images.shape[-1]))
        weights = np.zeros((*shape, 1))
        nearness = self.nearness(shape)
        for face in range(len(images)):
            row, column = self.positions(shape, np.full(shape, face))
            a, b = (
                (line - (side - 1) / 2) / (side / 2)
                for line, side in ((column, self.size[1]), (row, self.size[0]))
            )
            seen = (nearness[..., face] > 0) & (np.abs(a) < 1) & (np.abs(b) < 1)
            weight = np.sqrt(np.where(seen, (1 - a**2) * (1 - b**2), 0))[..., None]
            total += weight * sample_images(images, np.full(shape, face), row, column)
            weights += weight
        return total / weights

    def clear(self, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Panorama pixels that are not half-way between two centers: their owner is certain."""
        return certain_labels(self.nearness(shape), margin=1e-9)


def certain_nearest(lonlat: Array, shape: tuple[int, int], margin: float) -> NDArray[np.bool_]:
    """Positions whose nearest panorama pixel is not decided by rounding."""
    row, column = panorama_position(lonlat, shape)
    return np.asarray(
        (np.abs(row - np.floor(row) - 0.5) > margin)
        & (np.abs(column - np.floor(column) - 0.5) > margin)
    )


def certain_labels(logits: Array, margin: float) -> NDArray[np.bool_]:
    """Pixels whose best class leads by more than rounding."""
    second, first = np.moveaxis(np.sort(logits, axis=-1)[..., -2:], -1, 0)
    return np.asarray(first - second > margin)
