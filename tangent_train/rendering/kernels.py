"""Compiled loops that find where pixels are: ERP positions and owners."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tangent_train.rendering.compiled import njit_exact

__all__ = ["directions_of_rows", "owner_table", "pinhole_map", "rotation_map"]


@njit_exact
def _equirect_pixel(
    x: float,
    y: float,
    z: float,
    height: int,
    width: int,
) -> tuple[float, float]:
    """Column and row of a direction of any length."""
    u = (math.atan2(y, x) / (2 * math.pi) + 0.5) * width - 0.5
    v = (0.5 - math.atan2(z, math.sqrt(x * x + y * y)) / math.pi) * height - 0.5
    return u, v


@njit_exact
def pinhole_map(
    start: int,
    stop: int,
    world_from_pixel: NDArray[np.float64],
    height: int,
    width: int,
    u: NDArray[np.floating],
    v: NDArray[np.floating],
) -> None:
    """ERP positions of the pixels of pinhole images, one below the other, rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        world_from_pixel: ``(n, 3, 3)`` matrices from homogeneous pixels (column, row, 1) to
            directions.
        height: Rows H of the ERP.
        width: Columns W of the ERP.
        u: ``(n h, w)`` columns, written.
        v: ``(n h, w)`` rows, written.
    """
    image_height = u.shape[0] // len(world_from_pixel)
    for row in range(start, stop):
        m = world_from_pixel[row // image_height]
        i = row % image_height
        for j in range(u.shape[1]):
            x = m[0, 0] * j + m[0, 1] * i + m[0, 2]
            y = m[1, 0] * j + m[1, 1] * i + m[1, 2]
            z = m[2, 0] * j + m[2, 1] * i + m[2, 2]
            u[row, j], v[row, j] = _equirect_pixel(x, y, z, height, width)


@njit_exact
def directions_of_rows(
    height: int,
    width: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``(W, 2)`` cos λ, sin λ of the columns and ``(H, 2)`` cos φ, sin φ of the rows."""
    columns = np.empty((width, 2))
    for j in range(width):
        lon = (j + 0.5) / width * 2 * math.pi - math.pi
        columns[j, 0] = math.cos(lon)
        columns[j, 1] = math.sin(lon)
    rows = np.empty((height, 2))
    for i in range(height):
        lat = math.pi / 2 - (i + 0.5) / height * math.pi
        rows[i, 0] = math.cos(lat)
        rows[i, 1] = math.sin(lat)
    return columns, rows


@njit_exact
def rotation_map(
    start: int,
    stop: int,
    turn: NDArray[np.float64],
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
) -> None:
    """ERP positions, in the same shape, of the turned directions of the rows ``start:stop``.

    Args:
        start: First row.
        stop: One past the last row.
        turn: ``(3, 3)`` matrix applied to the directions.
        columns: From `directions_of_rows`.
        rows: From `directions_of_rows`.
        u: ``(H, W)`` columns, written.
        v: ``(H, W)`` rows, written.
    """
    height, width = u.shape
    m = turn
    for i in range(start, stop):
        c = rows[i, 1]
        for j in range(width):
            a = rows[i, 0] * columns[j, 0]
            b = rows[i, 0] * columns[j, 1]
            x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
            y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c
            z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c
            u[i, j], v[i, j] = _equirect_pixel(x, y, z, height, width)


@njit_exact
def _nearest_center(
    axes: NDArray[np.float64],
    neighbors: NDArray[np.integer],
    inner: float,
    face: int,
    x: float,
    y: float,
    z: float,
) -> int:
    """Walk to ever nearer centres; `inner` is a cosine beyond which no other face can be nearer."""
    best = axes[face, 0, 2] * x + axes[face, 1, 2] * y + axes[face, 2, 2] * z
    while best < inner:
        nearer = face
        for k in range(neighbors.shape[1]):
            other = neighbors[face, k]
            dot = axes[other, 0, 2] * x + axes[other, 1, 2] * y + axes[other, 2, 2] * z
            if dot > best:
                best = dot
                nearer = other
        if nearer == face:
            break
        face = nearer
    return face


@njit_exact
def owner_table(
    start: int,
    stop: int,
    axes: NDArray[np.float64],
    neighbors: NDArray[np.integer],
    inner: float,
    focal: float,
    center: float,
    columns: NDArray[np.float64],
    rows: NDArray[np.float64],
    face: NDArray[np.integer],
    u: NDArray[np.floating],
    v: NDArray[np.floating],
) -> None:
    """Owner of every pixel of the rows ``start:stop`` and its position in the owner's image.

    Args:
        start: First row.
        stop: One past the last row.
        axes: ``(N, 3, 3)`` camera axes of the images, as columns.
        neighbors: ``(N, 12)`` faces around every face.
        inner: Cosine of half the angle between the nearest two centres.
        focal: Focal length of the images in pixels.
        center: Middle of the images in pixels.
        columns: From `directions_of_rows`.
        rows: From `directions_of_rows`.
        face: ``(H, W)`` owners, written.
        u: ``(H, W)`` columns in the image, written.
        v: ``(H, W)`` rows in the image, written.
    """
    own = 0
    for i in range(start, stop):
        z = rows[i, 1]
        for j in range(columns.shape[0]):
            x = rows[i, 0] * columns[j, 0]
            y = rows[i, 0] * columns[j, 1]
            own = _nearest_center(axes, neighbors, inner, own, x, y, z)
            m = axes[own]
            scale = focal / (m[0, 2] * x + m[1, 2] * y + m[2, 2] * z)
            face[i, j] = own
            u[i, j] = (m[0, 0] * x + m[1, 0] * y + m[2, 0] * z) * scale + center
            v[i, j] = (m[0, 1] * x + m[1, 1] * y + m[2, 1] * z) * scale + center
