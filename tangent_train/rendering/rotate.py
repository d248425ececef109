"""Rotation of whole panoramas."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.geometry import checked_rotation
from tangent_train.rendering.checks import check_panorama
from tangent_train.rendering.forward import Interpolation
from tangent_train.rendering.kernels import sphere_rays
from tangent_train.rendering.sampling import (
    EquirectMap,
    equirect_map,
    map_dtype,
    sample_map,
)

__all__ = ["rotate_equirect"]

Scalar = TypeVar("Scalar", bound=np.generic)


def rotate_equirect(
    image: NDArray[Scalar], rotation: ArrayLike, interpolation: Interpolation = "bilinear"
) -> NDArray[Scalar]:
    """Rotate a panorama: direction d of the result shows the input at Rᵀd.

    Args:
        image: ``(H, W[, C])``, as `equirect_to_tangent` takes it.
        rotation: ``(3, 3)`` rotation R.
        interpolation: ``bilinear`` or ``nearest``.

    Returns:
        Same shape and dtype.

    Raises:
        SettingError: The panorama, the rotation or the interpolation cannot be used.
    """
    check_panorama(image, interpolation)
    rotated = checked_rotation(rotation)
    dtype = map_dtype(image.dtype == np.float64, interpolation)
    table = _rotation_map(rotated.tobytes(), (image.shape[0], image.shape[1]), dtype)
    out = np.empty_like(image, order="C")
    sample_map(table, np.ascontiguousarray(image), interpolation, out)
    return out


@lru_cache(maxsize=1)
def _rotation_map(
    rotation: bytes, shape: tuple[int, int], dtype: np.dtype[np.floating]
) -> EquirectMap:
    """Source positions of all directions; kept for the other parts of the same panorama."""
    inverse = np.frombuffer(rotation).reshape(1, 3, 3).transpose(0, 2, 1)
    return equirect_map(inverse, sphere_rays(shape), shape, dtype)
