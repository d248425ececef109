"""Radial lens distortion with one coefficient, after Brown (1966) and Conrady, both ways.

A point at distance r from the optical axis, on the plane at distance 1, is imaged at
``r (1 + K1 r²)``, as OpenCV has it: K1 > 0 pushes points outwards, the more the farther they are, a
pincushion. (Written from the distorted radius to the true one, as in Brown's paper, the same sign
would be a barrel.)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError

__all__ = ["distort", "undistort"]


def distort(points_xy: ArrayLike, k1: float) -> NDArray[np.float64]:
    """Where the lens images points: ``x (1 + K1 r²)``.

    Args:
        points_xy: ``(..., 2)`` undistorted, the optical axis at (0, 0).
        k1: Coefficient K1, 0 or more.

    Returns:
        ``(..., 2)`` distorted points.

    Raises:
        SettingError: The coefficient is negative.
    """
    points = np.asarray(points_xy, np.float64)
    return points * (1 + _checked(k1) * (points**2).sum(axis=-1, keepdims=True))


def undistort(points_xy: ArrayLike, k1: float) -> NDArray[np.float64]:
    """Which points the lens images here: the inverse of `distort`, in closed form.

    The cubic ``K1 r³ + r = r'`` has one real root, ``2 q sinh(asinh(3 r' / (2 q)) / 3)`` with
    ``q = 1/√(3 K1)``.

    Args:
        points_xy: ``(..., 2)`` distorted, the optical axis at (0, 0).
        k1: Coefficient K1, 0 or more.

    Returns:
        ``(..., 2)`` undistorted points.

    Raises:
        SettingError: The coefficient is negative.
    """
    points = np.asarray(points_xy, np.float64)
    if _checked(k1) == 0:
        return points.copy()
    q = 1 / np.sqrt(3 * k1)
    imaged = np.hypot(points[..., :1], points[..., 1:])
    true = 2 * q * np.sinh(np.arcsinh(3 * imaged / (2 * q)) / 3)
    return points * np.divide(true, imaged, out=np.ones_like(true), where=imaged > 0)


def _checked(k1: float) -> float:
    if not 0 <= k1 < np.inf:
        raise SettingError(
            "K1",
            found=k1,
            expected="0 or more",
            remedy="A negative one folds the plane over itself far from the axis.",
        )
    return k1
