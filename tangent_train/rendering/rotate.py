"""Other views of a panorama: a pinhole camera's, and the whole sphere rotated."""

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
    pinhole_equirect_map,
    sample_map,
)

__all__ = ["equirect_to_perspective", "rotate_equirect"]

Scalar = TypeVar("Scalar", bound=np.generic)


def equirect_to_perspective(
    image: NDArray[Scalar],
    camera_matrix: ArrayLike,
    size: tuple[int, int],
    world_from_camera: ArrayLike,
    interpolation: Interpolation = "bilinear",
) -> NDArray[Scalar]:
    """Render one pinhole view from a panorama.

    Args:
        image: ``(H, W[, C])``, as `equirect_to_tangent` takes it.
        camera_matrix: ``(3, 3)`` K for integer pixel centres.
        size: ``(height, width)`` of the view.
        world_from_camera: ``(3, 3)`` camera axes (x right, y down, z forward) as columns, as
            `TangentGrid.world_from_camera`: the determinant of an upright camera is −1.
        interpolation: ``bilinear`` or ``nearest``.

    Returns:
        ``(height, width[, C])`` of the dtype of the image.

    Raises:
        SettingError: The panorama or the interpolation cannot be used.
    """
    check_panorama(image, interpolation)
    matrix = np.linalg.inv(np.asarray(camera_matrix, np.float64))
    world_from_pixel = np.asarray(world_from_camera, np.float64) @ matrix
    dtype = map_dtype(image.dtype == np.float64, interpolation)
    shape = image.shape[0], image.shape[1]
    table = pinhole_equirect_map(world_from_pixel, size, shape, dtype)
    return _sampled(image, table, interpolation)


def rotate_equirect(
    image: NDArray[Scalar], rotation: ArrayLike, interpolation: Interpolation = "bilinear"
) -> NDArray[Scalar]:
    """Rotate what a panorama shows: direction d of the result shows the input at Rᵀd.

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
    return _sampled(image, table, interpolation)


@lru_cache(maxsize=1)
def _rotation_map(
    rotation: bytes, shape: tuple[int, int], dtype: np.dtype[np.floating]
) -> EquirectMap:
    """Where each direction comes from; kept for the other parts of the same panorama."""
    inverse = np.frombuffer(rotation).reshape(1, 3, 3).transpose(0, 2, 1)
    return equirect_map(inverse, sphere_rays(shape), shape, dtype)


def _sampled(
    image: NDArray[Scalar], table: EquirectMap, interpolation: Interpolation
) -> NDArray[Scalar]:
    out = np.empty((*table.u.shape, *image.shape[2:]), image.dtype)
    sample_map(table, np.ascontiguousarray(image), interpolation, out)
    return out
