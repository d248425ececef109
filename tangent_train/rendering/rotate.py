"""Other views of a panorama: a pinhole camera's, and the whole sphere turned."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tangent_train.geometry import checked_rotation
from tangent_train.rendering.checks import check_interpolation, check_numpy_image
from tangent_train.rendering.forward import Interpolation
from tangent_train.rendering.kernels import directions_of_rows, rotation_map
from tangent_train.rendering.sampling import EquirectMap, map_dtype, pinhole_equirect_map
from tangent_train.rendering.threads import over_rows

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
    check_interpolation(interpolation)
    check_numpy_image(image, interpolation)
    matrix = np.linalg.inv(np.asarray(camera_matrix, np.float64))
    world_from_pixel = np.asarray(world_from_camera, np.float64) @ matrix
    dtype = map_dtype(image.dtype == np.float64, interpolation)
    table = pinhole_equirect_map(world_from_pixel, size, image.shape[:2], dtype)
    return _sampled(image, table, interpolation)


def rotate_equirect(
    image: NDArray[Scalar], rotation: ArrayLike, interpolation: Interpolation = "bilinear"
) -> NDArray[Scalar]:
    """Turn what a panorama shows: direction d of the result shows the input at Rᵀd.

    Args:
        image: ``(H, W[, C])``, as `equirect_to_tangent` takes it.
        rotation: ``(3, 3)`` rotation R.
        interpolation: ``bilinear`` or ``nearest``.

    Returns:
        Same shape and dtype.

    Raises:
        SettingError: The panorama, the rotation or the interpolation cannot be used.
    """
    check_interpolation(interpolation)
    check_numpy_image(image, interpolation)
    shape = (image.shape[0], image.shape[1])
    dtype = map_dtype(image.dtype == np.float64, interpolation)
    turned = checked_rotation(rotation)
    return _sampled(image, _rotation_map(turned.tobytes(), shape, dtype), interpolation)


@lru_cache(maxsize=1)
def _rotation_map(rotation: bytes, shape: tuple[int, int], dtype: DTypeLike) -> EquirectMap:
    """Where each direction comes from; kept for the other parts of the same panorama."""
    u, v = np.empty((2, *shape), dtype)
    inverse = np.ascontiguousarray(np.frombuffer(rotation).reshape(3, 3).T)
    over_rows(rotation_map, shape, inverse, *directions_of_rows(*shape), u, v)
    return EquirectMap(u, v, shape)


def _sampled(
    image: NDArray[Scalar], table: EquirectMap, interpolation: Interpolation
) -> NDArray[Scalar]:
    out = np.empty((*table.u.shape, *image.shape[2:]), image.dtype)
    table.sample(np.ascontiguousarray(image), interpolation, out)
    return out
