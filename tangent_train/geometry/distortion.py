"""How maps of the sphere onto planes distort, in closed form (Tissot 1881; Snyder 1987).

A map has two principal scales at a point, the greatest and the least factor by which it stretches
short lines there. Their product is the scale of areas; how much they differ is the distortion of
angles. A zoom of the whole map changes both scales alike and distorts nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "angular_distortion",
    "equirect_mean_angular_distortion",
    "equirect_mean_area_deviation",
    "equirect_scales",
    "gnomonic_scales",
    "principal_scales",
]

Scales = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Greatest and least principal scale."""


def gnomonic_scales(angle_rad: ArrayLike) -> Scales:
    """Principal scales of pinhole images, tangent images and cube faces: 1/cos²θ and 1/cos θ.

    Args:
        angle_rad: ``(...)`` θ from the centre of the image; the plane is at distance 1.

    Returns:
        Scales away from the centre and around it.
    """
    cos = np.cos(np.asarray(angle_rad, np.float64))
    return 1 / cos**2, 1 / cos


def equirect_scales(lat_rad: ArrayLike) -> Scales:
    """Principal scales of the equirectangular panorama: 1/cos φ and 1.

    Args:
        lat_rad: ``(...)`` latitude φ; the panorama is as wide as the equator is long.

    Returns:
        Scales along the parallel and along the meridian.
    """
    cos = np.cos(np.asarray(lat_rad, np.float64))
    return 1 / cos, np.ones_like(cos)


def angular_distortion(greatest: ArrayLike, least: ArrayLike) -> NDArray[np.float64]:
    """Most that the angle between two directions changes: 2 asin((a − b)/(a + b)), in radians.

    Args:
        greatest: ``(...)`` principal scale a.
        least: ``(...)`` principal scale b.

    >>> np.degrees(angular_distortion([1, 2, 3], [1, 1, np.sqrt(3)])).round(2).tolist()
    [0.0, 38.94, 31.08]
    """
    a, b = np.asarray(greatest, np.float64), np.asarray(least, np.float64)
    return 2 * np.arcsin((a - b) / (a + b))


def principal_scales(sphere_from_plane: ArrayLike) -> Scales:
    """Principal scales of a map given by the derivatives of its inverse.

    Args:
        sphere_from_plane: ``(..., 3, 2)`` change of the direction for a unit step along each axis
            of the plane.

    Returns:
        Greatest and least scale.
    """
    steps = np.asarray(sphere_from_plane, np.float64)
    right, down = steps[..., 0], steps[..., 1]
    # Singular values of 3×2 matrices from their sum and product: a thousandth of the SVD's time.
    area = np.linalg.norm(np.cross(right, down), axis=-1)
    squares = (right**2 + down**2).sum(axis=-1)
    plus, minus = np.sqrt(squares + 2 * area), np.sqrt(np.maximum(squares - 2 * area, 0))
    return 2 / (plus - minus), 2 / (plus + minus)


def equirect_mean_angular_distortion() -> float:
    """Mean over the sphere of the panorama's angular distortion: 0.29376 (16.83°).

    By parts, ∫ 2 asin(tan²(φ/2)) cos φ dφ = π − 2 ∫ (cos φ)^−½ − (cos φ)^½ dφ over [0, π/2], Beta
    functions.
    """

    def power_of_cosine(exponent: float) -> float:
        top, bottom = math.gamma((exponent + 1) / 2), math.gamma(exponent / 2 + 1)
        return math.sqrt(math.pi) / 2 * top / bottom

    return math.pi - 2 * (power_of_cosine(-0.5) - power_of_cosine(0.5))


def equirect_mean_area_deviation() -> float:
    """Mean over the sphere of |σ/σ̄ − 1| of the panorama's scale of areas σ: 0.42103.

    σ̄ is π/2; inside the latitude φ₀ with cos φ₀ = 2/π areas are shown too small, outside too
    large, by as much: 2 (sin φ₀ − 2 φ₀/π).
    """
    middle = math.acos(2 / math.pi)
    return 2 * (math.sin(middle) - 2 * middle / math.pi)
