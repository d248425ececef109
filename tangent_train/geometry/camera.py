"""Perspective cameras and their normalisation (paper, supplement, "Camera normalization")."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError


class NormalizedCamera(NamedTuple):
    """A common camera and the way to it.

    Attributes:
        camera_matrix: ``(3, 3)`` K', pixel centres at integers.
        homography: ``(3, 3)`` K'(K+Δ)⁻¹, from old to new homogeneous pixels (x, y, 1).
    """

    camera_matrix: NDArray[np.float64]
    homography: NDArray[np.float64]


def camera_matrix_from_fov(fov_deg: float, size: tuple[int, int]) -> NDArray[np.float64]:
    """Pinhole matrix with square pixels and the centre in the middle of the image.

    Args:
        fov_deg: Horizontal field of view between the outer pixel edges, in degrees.
        size: ``(height, width)`` in pixels.

    Returns:
        ``(3, 3)`` K for integer pixel centres: the middle of n pixels is (n − 1)/2, where
        conventions that count from pixel corners (the paper's) have n/2.

    Raises:
        SettingError: The field of view is not between 0° and 180°.
    """
    if not 0 < fov_deg < 180:
        raise SettingError("fov_deg", found=fov_deg, expected="more than 0 and less than 180")
    height, width = size
    focal = width / (2 * math.tan(math.radians(fov_deg) / 2))
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])


def is_camera_matrix(matrix: NDArray[np.float64]) -> bool:
    """Whether an array of any shape is a ``(3, 3)`` K without skew, with focal lengths above 0."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    plain = matrix[2].tolist() == [0, 0, 1] and matrix[0, 1] == matrix[1, 0] == 0
    return bool(plain and np.diag(matrix).min() > 0)


def perspective_directions(camera_matrix: ArrayLike, size: tuple[int, int]) -> NDArray[np.float64]:
    """Unit directions of the pixel centres of a pinhole image, in camera axes.

    Args:
        camera_matrix: ``(3, 3)`` K for integer pixel centres.
        size: ``(height, width)``.

    Returns:
        ``(height, width, 3)``: x right, y down, z forward. The distance along a ray is the z-depth
        divided by its z component.
    """
    height, width = size
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones(size)], axis=-1)
    rays = pixels @ np.linalg.inv(np.asarray(camera_matrix, np.float64)).T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def shift_range(
    camera_matrix: ArrayLike,
    size: tuple[int, int],
    fov_deg: float = 45.0,
    dim: int | tuple[int, int] = 128,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Shifts of the principal point that keep the normalised crop inside the image.

    The crop's outer corners, moved by P = K K'⁻¹ and the shift δ, must stay inside the image
    (paper, supplement, the inequalities after equation "shiftedcamnorm").

    Args:
        camera_matrix: ``(3, 3)`` K of the image, integer pixel centres, without skew.
        size: ``(height, width)`` of the image.
        fov_deg: Horizontal field of view Ω' of the crop.
        dim: Side of the crop, or its ``(height, width)``; pixels are square, so that only their
            ratio counts.

    Returns:
        Least and greatest ``(δx, δy)`` in pixels.

    Raises:
        SettingError: The image is too small for the field of view.
    """
    matrix = np.asarray(camera_matrix, np.float64)
    focal, center = np.diag(matrix)[:2], matrix[:2, 2]
    half_sides = np.array(_height_width(dim)[::-1]) / 2
    extent = focal * math.tan(math.radians(fov_deg) / 2) * half_sides / half_sides[0]
    least = extent - center - 0.5
    greatest = np.array(size[::-1]) - 0.5 - extent - center
    if np.any(least > greatest + 1e-9):
        wanted = np.degrees(2 * np.arctan(extent / focal))
        widest = np.degrees(2 * np.arctan(np.array(size[::-1]) / (2 * focal)))
        raise SettingError(
            "field of view",
            found=f"{_degrees(wanted)} for an image that spans {_degrees(widest)}",
            expected="a field of view inside the image",
            remedy="Ask for less, or leave the image out.",
        )
    return least, np.maximum(least, greatest)


def normalize_camera(
    K: ArrayLike,
    size: tuple[int, int],
    fov: float = 45.0,
    dim: int | tuple[int, int] = 128,
    shift: tuple[float, float] = (0.0, 0.0),
) -> NormalizedCamera:
    """The common camera with the panorama's angular resolution, and the homography to it.

    ``f' = W' / (2 tan(Ω'/2))`` and ``x' = K'(K+Δ)⁻¹x`` (paper, supplement, equations "camnorm" and
    "shiftedcamnorm"). The paper's centre W'/2 counts from pixel corners; here it is (W' − 1)/2.

    Args:
        K: ``(3, 3)`` camera matrix of the image, integer pixel centres.
        size: ``(height, width)`` of the image.
        fov: Horizontal field of view Ω' in degrees; the vertical one follows from square pixels.
        dim: Side W' = H' in pixels, 128 for level 8 at 45°; or ``(H', W')``.
        shift: ``(δx, δy)`` added to the principal point, within `shift_range`.

    Returns:
        K' and the homography from old to new pixels.

    Raises:
        SettingError: The image is too small for the field of view, or the shift leaves it.
    """
    least, greatest = shift_range(K, size, fov, dim)
    delta = np.asarray(shift, np.float64)
    if np.any(delta < least - 1e-9) or np.any(delta > greatest + 1e-9):
        raise SettingError(
            "shift", found=shift, expected=f"{least.tolist()} to {greatest.tolist()}"
        )
    moved = np.array(K, np.float64)
    moved[:2, 2] += delta
    target = camera_matrix_from_fov(fov, _height_width(dim))
    return NormalizedCamera(target, target @ np.linalg.inv(moved))


def _height_width(dim: int | tuple[int, int]) -> tuple[int, int]:
    return (dim, dim) if isinstance(dim, int) else dim


def _degrees(width_height: NDArray[np.float64]) -> str:
    return f"{width_height[0]:.4g}° × {width_height[1]:.4g}°"
