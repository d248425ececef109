"""What each image of a grid owns, as a polygon on its plane, and means over all of them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry.pinhole_grid import Faces, PinholeGrid

__all__ = ["mean_over_owned", "owned_polygons"]

_SAME = 1e-9
"""Lengths on the plane below this are rounding."""


def owned_polygons(grid: PinholeGrid, faces: Faces | None = None) -> NDArray[np.float64]:
    """Corners of what images own, on the plane at distance 1 in front of it.

    A direction is an image's where its centre is the nearest: the borders are the bisectors to the
    neighbours, straight lines on the plane.

    Args:
        grid: The images.
        faces: Those asked for, default all.

    Returns:
        ``(n, k, 2)`` right and down, once around; the last corner stands more than once where an
        image has fewer than the most.

    Raises:
        SettingError: A face is out of range.
    """
    chosen = grid.face_indices(faces)
    around = grid.centers_xyz[grid.neighbors[chosen]]
    near = np.einsum("nkw,nwc->nkc", around, grid.world_from_camera[chosen])
    slope, reach = near[..., :2], 1 - near[..., 2]  # inside: slope · (x, y) ≤ reach
    one, other = np.array(list(combinations(range(near.shape[1]), 2))).T
    (ax, ay), (bx, by) = np.moveaxis(slope[:, one], -1, 0), np.moveaxis(slope[:, other], -1, 0)
    det = ax * by - ay * bx
    crossing = np.abs(det) > _SAME
    det = np.where(crossing, det, 1.0)
    x = (reach[:, one] * by - reach[:, other] * ay) / det
    y = (reach[:, other] * ax - reach[:, one] * bx) / det
    corners = np.stack([x, y], axis=-1)
    beyond = (np.einsum("npc,nkc->npk", corners, slope) - reach[:, None]).max(axis=-1)
    return _around(corners, crossing & (beyond < _SAME))


def mean_over_owned(
    grid: PinholeGrid,
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    faces: Faces | None = None,
) -> float:
    """Mean over what images own, by solid angle, of a function of the angle to the owner's centre.

    Polygons are split into triangles around the centre, each integrated by Gauss's rule with 16²
    nodes: exact to rounding for what is smooth, to about 1e-4 for what has kinks.

    Args:
        grid: The images.
        function: Of angles ``(...)`` in radians.
        faces: Images whose regions are meant, default all: the whole sphere.

    Returns:
        The mean.

    Raises:
        SettingError: A face is out of range.
    """
    corners = owned_polygons(grid, faces)
    one, other = corners, np.roll(corners, -1, axis=1)
    twice_area = np.abs(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
    there = twice_area > _SAME**2
    one, other, twice_area = one[there], other[there], twice_area[there]
    nodes, weights = np.polynomial.legendre.leggauss(16)
    nodes, weights = (nodes + 1) / 2, weights / 2
    total = covered = 0.0
    for outward, weight in zip(nodes, weights, strict=True):
        for along, share in zip(nodes, weights, strict=True):
            points = outward * ((1 - along) * one + along * other)
            radius = np.hypot(points[:, 0], points[:, 1])
            solid_angle = outward * twice_area / (1 + radius**2) ** 1.5
            covered += weight * share * float(solid_angle.sum())
            total += weight * share * float(function(np.arctan(radius)) @ solid_angle)
    return total / covered


def _around(corners: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The valid ones of ``(N, p, 2)`` points in order around the origin; see `owned_polygons`."""
    angle = np.where(valid, np.arctan2(corners[..., 1], corners[..., 0]), np.inf)
    order = np.argsort(angle, axis=1)[:, : valid.sum(axis=1).max()]
    last = valid.sum(axis=1, keepdims=True) - 1
    order = np.take_along_axis(order, np.minimum(np.arange(order.shape[1]), last), axis=1)
    return np.take_along_axis(corners, order[..., None], axis=1)
