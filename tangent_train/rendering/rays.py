"""Rays through the pixels of panoramas and images, where they meet a panorama, and who owns them.

The ray of pixel (i, j) is ``(rows[i, 0] columns[0, j], rows[i, 0] columns[1, j], rows[i, 1])``,
with the factors of `sphere_rays` or `plane_rays`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_exact

Array = NDArray[Any]
Rays = tuple[Array, Array]
"""``(2, W)`` factors of the columns and ``(H, 2)`` factors of the rows, float64."""


def sphere_rays(shape: tuple[int, int]) -> Rays:
    """Unit directions of a panorama's pixels: cos λ, sin λ and cos φ, sin φ."""
    height, width = shape
    lon = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    lat = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    return np.stack([np.cos(lon), np.sin(lon)]), np.stack([np.cos(lat), np.sin(lat)], -1)


def plane_rays(shape: tuple[int, int]) -> Rays:
    """``(j, 1, i)`` of the pixels of an image: its homogeneous pixels in another order."""
    height, width = shape
    columns = np.stack([np.arange(width, dtype=np.float64), np.ones(width)])
    return columns, np.stack([np.ones(height), np.arange(height, dtype=np.float64)], -1)


@njit_exact
def equirect_positions(
    start: int, stop: int, matrices: Array, columns: Array, rows: Array,
    height: int, width: int, u: Array, v: Array,
) -> None:  # fmt: skip
    """ERP positions of the rays of canvases, one below the other, rows ``start:stop``.

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


@njit_exact
def find_owners(
    start: int, stop: int, centers: Array, neighbors: Array, inner: float,
    columns: Array, rows: Array, face: Array,
) -> None:  # fmt: skip
    """Find the image with the nearest centre, for the ERP rows ``start:stop``.

    Steps to ever nearer centres, starting from the owner of the previous pixel.

    Args:
        start: First row.
        stop: One past the last row.
        centers: ``(N, 3)`` directions of the images' centres.
        neighbors: ``(N, k)`` images around every image.
        inner: Cosine of half the angle between the nearest two centres: a centre nearer than that
            is the nearest.
        columns: From `sphere_rays`.
        rows: From `sphere_rays`.
        face: ``(H, W)`` owners, written.
    """
    own = 0
    for i in range(start, stop):
        z = rows[i, 1]
        for j in range(columns.shape[1]):
            x, y = rows[i, 0] * columns[0, j], rows[i, 0] * columns[1, j]
            best = centers[own, 0] * x + centers[own, 1] * y + centers[own, 2] * z
            while best < inner:
                nearer = own
                for other in neighbors[own]:
                    dot = centers[other, 0] * x + centers[other, 1] * y + centers[other, 2] * z
                    if dot > best:
                        best, nearer = dot, other
                if nearer == own:
                    break
                own = nearer
            face[i, j] = own
