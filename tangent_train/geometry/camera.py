"""Perspective cameras and their normalization (paper, supplement, "Camera normalization")."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike

from tangent_train.errors import SettingError, check_type
from tangent_train.geometry.sphere import Floats, equirect_solid_angles


def half_width(fov_deg: float) -> float:
    """Return half the width of an image in focal lengths, given its field of view.

    Raises:
        SettingError: The field of view is not between 0° and 180°.
    """
    check_type("fov", fov_deg, Real, "degrees")
    if not 0 < fov_deg < 180:
        raise SettingError("fov", found=fov_deg, expected="more than 0 and less than 180 degrees")
    return math.tan(math.radians(fov_deg) / 2)


def camera_matrix_from_fov(fov_deg: float, size: tuple[int, int]) -> Floats:
    """Return a pinhole matrix with square pixels and the center in the middle of the image.

    Args:
        fov_deg: Horizontal field of view between the outer pixel edges, in degrees.
        size: ``(height, width)`` in pixels.

    Returns:
        ``(3, 3)`` K for integer pixel centers: the middle of n pixels is (n − 1)/2, where
        conventions that count from pixel corners (the paper's) have n/2.

    Raises:
        SettingError: The field of view is not between 0° and 180°.
    """
    height, width = size
    focal = width / (2 * half_width(fov_deg))
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])


def is_camera_matrix(matrix: Floats) -> bool:
    """Return True for a ``(3, 3)`` K without skew and with focal lengths above 0."""
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return False
    is_plain = matrix[2].tolist() == [0, 0, 1] and matrix[0, 1] == matrix[1, 0] == 0
    return bool(is_plain and np.diag(matrix).min() > 0)


def perspective_directions(camera_matrix: ArrayLike, size: tuple[int, int]) -> Floats:
    """Return unit directions of the pixel centers of a pinhole image, in camera axes.

    Args:
        camera_matrix: ``(3, 3)`` K for integer pixel centers.
        size: ``(height, width)``.

    Returns:
        ``(height, width, 3)``: x right, y down, z forward. The distance along a ray is the z-depth
        divided by its z component.
    """
    height, width = size
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones(size)], axis=-1)
    rays = pixels @ np.linalg.inv(np.asarray(camera_matrix, np.float64)).T
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def ray_lengths(camera_matrix: Floats, size: tuple[int, ...]) -> Floats:
    """Return the ratio of distance to z-depth for every pixel of an image, ``(height, width)``.

    Args:
        camera_matrix: ``(3, 3)`` K for integer pixel centers, without skew.
        size: ``(height, width)``.
    """
    x, y = (
        (np.arange(size[1 - axis]) - camera_matrix[axis, 2]) / camera_matrix[axis, axis]
        for axis in (0, 1)
    )
    return lengths_of_rays(x, y)


def pixel_solid_angles(shape: tuple[int, ...], camera_matrix: Floats | None = None) -> Floats:
    """Return the solid angle ``(H, W)`` of each pixel of a panorama, or of a photo, in steradians.

    A photo's pixel at (x, y) on the plane at distance 1 has the angle (1 + x² + y²)^(−3/2) / f².

    Args:
        shape: ``(H, W)``.
        camera_matrix: ``(3, 3)`` K of a photo, integer pixel centers; None for a panorama, whose
            angles are one number of a row, which saves memory.
    """
    if camera_matrix is None:
        return np.broadcast_to(equirect_solid_angles((shape[0], shape[1]))[:, None], shape)
    angles: Floats = ray_lengths(camera_matrix, shape) ** -3
    return angles / (camera_matrix[0, 0] * camera_matrix[1, 1])


def lengths_of_rays(x: Floats, y: Floats) -> Floats:
    """Return √(1 + x² + y²) ``(…, h, w)`` for columns ``(…, w)`` and rows ``(…, h)``.

    They are positions on the image plane at distance 1, whose rays are (x, y, 1).
    """
    return np.asarray(np.sqrt(1 + x[..., None, :] ** 2 + y[..., :, None] ** 2))


def shift_range(
    camera_matrix: ArrayLike, size: tuple[int, int], fov_deg: float, crop: tuple[int, int]
) -> tuple[Floats, Floats]:
    """Return the shifts of the principal point that keep the normalized crop inside the image.

    The crop's outer corners, moved by P = K K'⁻¹ and the shift δ, must stay inside the image
    (paper, supplement, the inequalities after equation "shiftedcamnorm"). K' is the camera of the
    crop: ``f' = W' / (2 tan(Ω'/2))``.

    Args:
        camera_matrix: ``(3, 3)`` K of the image, integer pixel centers, without skew.
        size: ``(height, width)`` of the image.
        fov_deg: Horizontal field of view Ω' of the crop.
        crop: ``(height, width)`` of the crop; pixels are square, so that only their ratio counts.

    Returns:
        Smallest and largest ``(δx, δy)`` in pixels.

    Raises:
        SettingError: The image is too small for the field of view.
    """
    matrix = np.asarray(camera_matrix, np.float64)
    focal, center = np.diag(matrix)[:2], matrix[:2, 2]
    half_sides = np.array(crop[::-1]) / 2
    extent = focal * half_width(fov_deg) * half_sides / half_sides[0]
    least = extent - center - 0.5
    greatest = np.array(size[::-1]) - 0.5 - extent - center
    if np.any(least > greatest + 1e-9):
        wanted, widest = np.degrees(
            2 * np.arctan([extent / focal, np.array(size[::-1]) / (2 * focal)])
        ).round(2)
        raise SettingError(
            "field of view",
            found=f"{wanted.tolist()}° for an image that spans {widest.tolist()}°",
            expected="a field of view inside the image",
            remedy="Lower representation.fov_deg, or the rows in representation.dim.",
        )
    return least, np.maximum(least, greatest)
