"""Render panoramas to tangent images, and to rotated panoramas.

Arrays are sampled by `sample_map`, tensors by `tensors.render_tensor`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.errors import SettingError, check_choice, check_type
from tangent_train.geometry import Angles, PinholeGrid, checked_rotation, perspective_grid
from tangent_train.geometry.grids import Faces
from tangent_train.rendering.resampling import Interpolation, Pixels, is_tensor, reduce_to_pitch
from tangent_train.rendering.tables import (
    EquirectMap,
    forward_map,
    map_dtype,
    positions_of_rays,
    sphere_rays,
)

if TYPE_CHECKING:
    from torch import Tensor

Blend = Literal["nearest", "feather"]
"""``nearest``: each pixel is taken from the image that owns it. ``feather``: the average of all
images that cover a pixel, with weights that fall to 0 at the borders of the images."""

_TOGETHER = 2**16
"""Number of pixels sampled in one call: small images are grouped, to save calls."""
_REMAP_LIMIT = 32767
"""cv2.remap requires sides below SHRT_MAX."""
_REMAP_BILINEAR = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
_SAME_SIZE = {1: np.uint8, 2: np.uint16, 4: np.float32, 8: np.float64}
"""Nearest sampling copies bytes: a dtype of the same size stands for every other."""
_COPIED = 36
"""Largest part of a panorama that is copied, in bytes per position: copying more takes longer."""


def equirect_to_tangent(
    image: Pixels,
    grid: PinholeGrid,
    faces: Faces | None = None,
    interpolation: Interpolation = "bilinear",
) -> Pixels:
    """Render tangent images from a panorama (paper, section 3.2).

    Longitude wraps and rows reflect at the poles, for every interpolation. A panorama of another
    aspect ratio than 2:1 is treated as a stretched image of the whole sphere. With ``bilinear``, a
    panorama that is much finer than the images is first reduced by `reduce_to_pitch`; in a loop
    over images, do this before.

    Args:
        image: A tensor ``(..., C, H, W)`` on any device, differentiable; or an array
            ``(H, W[, C])``: uint8, uint16 and float32 are sampled by `cv2.remap` (see `sample_map`
            for its precision), other dtypes are slower.
        grid: Geometry of the images, a `TangentGrid` or a `CubeGrid`.
        faces: Indices of the images to render, by default all.
        interpolation: ``bilinear``, or ``nearest`` for labels and masks of any dtype.

    Returns:
        A tensor ``(..., n, C, h, w)`` or an array ``(n, h, w[, C])``, of the dtype of the image.

    Raises:
        SettingError: The panorama, a face or the interpolation cannot be used.
    """
    if is_tensor(image):
        from tangent_train.rendering.tensors import render_tensor

        return render_tensor(image, grid, faces, interpolation)
    check_panorama(image, interpolation)
    check_grid(grid)
    if interpolation == "bilinear":
        image = reduce_to_pitch(image, min(grid.pitches))
    indices, (rows, columns) = grid.face_indices(faces), grid.size
    # For random subsets of images, tables are cached per image: subsets rarely repeat.
    is_together = faces is None or grid.rotation is not None
    image = np.ascontiguousarray(image)
    step = max(1, _TOGETHER // max(rows * columns, 4 * rows)) if is_together else 1
    out = np.empty((len(indices) * rows, columns, *image.shape[2:]), image.dtype)
    dtype = map_dtype(image.dtype == np.float64, interpolation)
    for start in range(0, len(indices), step):
        faces = indices[start : start + step]
        table = forward_map(grid, (image.shape[0], image.shape[1]), faces, dtype)
        sample_map(table, image, interpolation, out[start * rows : (start + step) * rows])
    return out.reshape(len(indices), rows, *out.shape[1:])


def perspective(
    image: Pixels,
    yaw: Angles = 0.0,
    pitch: Angles = 0.0,
    fov: float | Sequence[float] = 90.0,
    size: int | Sequence[int] = (640, 480),
    roll: Angles = 0.0,
    interpolation: Interpolation = "bilinear",
) -> Pixels:
    """Render perspective images of a panorama in some directions, see `equirect_to_tangent`.

    Args:
        image: An array ``(H, W[, C])``, or a tensor ``(..., C, H, W)``, differentiable.
        yaw: Degrees to the right of the middle of the panorama; one, or one for each image.
        pitch: Degrees above the horizon; one, or one for each image.
        fov: Horizontal field of view in degrees, between the outer pixel edges; or the least
            horizontal and vertical one, because pixels are square.
        size: Width and height of the images in pixels, or one number for both.
        roll: Degrees by which the camera is rolled clockwise; one, or one for each image.
        interpolation: ``bilinear``, or ``nearest`` for labels, masks and depth.

    Returns:
        For lists of angles, an array ``(n, h, w[, C])`` or a tensor ``(..., n, C, h, w)``; without
        the axis of the images if all angles are numbers.

    Raises:
        SettingError: The panorama, an angle or the size cannot be used.

    >>> perspective(np.ones((32, 64, 3)), yaw=[0, 90, 180, 270], size=(40, 30)).shape
    (4, 30, 40, 3)
    """
    # A rotation keeps the positions of many directions out of the large cache of tables.
    grid = perspective_grid(yaw, pitch, fov, size, roll).with_rotation(np.eye(3))
    images: Any = equirect_to_tangent(image, grid, None, interpolation)
    if max(map(np.ndim, (yaw, pitch, roll))) == 0:
        images = images.squeeze(-4) if is_tensor(image) else images[0]
    return images


def rotate_equirect(
    image: Pixels, rotation: ArrayLike, interpolation: Interpolation = "bilinear"
) -> Pixels:
    """Rotate a panorama: direction d of the result shows the input at Rᵀd.

    Args:
        image: An array ``(H, W[, C])`` or a tensor ``(..., C, H, W)``, as for
            `equirect_to_tangent`.
        rotation: ``(3, 3)`` rotation R.
        interpolation: ``bilinear`` or ``nearest``.

    Returns:
        The rotated panorama, of the same shape and dtype.

    Raises:
        SettingError: The panorama, the rotation or the interpolation cannot be used.
    """
    check_panorama(image, interpolation)
    rotated = checked_rotation(rotation).tobytes()
    is_exact = str(image.dtype).endswith("float64")
    height, width = image.shape[-2:] if is_tensor(image) else image.shape[:2]
    table = _rotation_map(rotated, (height, width), map_dtype(is_exact, interpolation))
    if is_tensor(image):
        from tangent_train.rendering.tensors import sample_positions

        return sample_positions(image, table.u, table.v, interpolation)
    out = np.empty_like(image, order="C")
    sample_map(table, np.ascontiguousarray(image), interpolation, out)
    return out


@lru_cache(maxsize=1)
def _rotation_map(
    rotation: bytes, shape: tuple[int, int], dtype: np.dtype[np.floating]
) -> EquirectMap:
    """Return source positions of all pixels; cached for the depth and labels of a panorama."""
    inverse = np.frombuffer(rotation).reshape(1, 3, 3).transpose(0, 2, 1)
    return EquirectMap.of(*positions_of_rays(inverse, sphere_rays(shape), shape, dtype), shape)


def sample_map(
    table: EquirectMap,
    image: NDArray[np.generic],
    interpolation: str,
    out: NDArray[np.generic],
) -> None:
    """Sample a panorama; longitude wraps, and rows reflect at the poles.

    `cv2.remap` samples uint8, uint16 and float32 bilinearly, and the nearest pixel of all dtypes.
    OpenCV 4 may round positions to 1/32 pixel, which is invisible in 8-bit images; OpenCV 5 does
    not. Other dtypes are sampled without rounding.

    Args:
        table: Positions ``(h, w)``.
        image: ``(H, W[, C])``, contiguous.
        interpolation: ``bilinear`` or ``nearest``.
        out: ``(h, w[, C])`` contiguous, same dtype, written.
    """
    is_nearest = interpolation == "nearest"
    if is_nearest:
        plain = _SAME_SIZE[image.dtype.itemsize]
        image, out = image.view(plain), out.view(plain)
    top, bottom, left, right = table.part.tolist()
    part = image[top:bottom, left:right]
    if right > image.shape[1]:
        part = np.concatenate([part, image[top:bottom, : right - image.shape[1]]], axis=1)
    is_small = max(*part.shape[:2], *table.u.shape) < _REMAP_LIMIT
    if is_small and (is_nearest or image.dtype in _REMAP_BILINEAR):
        _remap(table, part, is_nearest, out)
    elif is_nearest:
        row = np.rint(table.v).astype(np.intp).clip(0, len(part) - 1)
        out[:] = part[row, np.rint(table.u).astype(np.intp) % part.shape[1]]
    else:
        out[:] = _interpolated(part, table.u, table.v)
    if not is_nearest and len(table.polar):
        _write_polar(table, image, out)


def _remap(
    table: EquirectMap, part: NDArray[np.generic], is_nearest: bool, out: NDArray[np.generic]
) -> None:
    """Sample a part of a panorama with `cv2.remap`."""
    # Copying the part row by row takes less time than waiting for memory at every position.
    is_copied = part.dtype.itemsize < 4 and part.nbytes <= _COPIED * table.u.size
    u, v = (line.astype(np.float32, copy=False) for line in table[:2])
    if is_nearest and len(table.polar):
        v = v.clip(0, len(part) - 1)
    flag = cv2.INTER_NEAREST if is_nearest else cv2.INTER_LINEAR
    channels = 1 if part.ndim == 2 else part.shape[2]
    is_padded = is_copied and channels % 3 == 0 and not is_nearest
    if part.ndim == 2 or (channels in (3, 4) and not is_padded):
        part = np.ascontiguousarray(part) if is_copied else part
        cv2.remap(part, u, v, flag, dst=out, borderMode=cv2.BORDER_WRAP)
        return
    # cv2 is fastest with 4 channels. It refuses more than 4, or rounds their positions.
    several = 3 if channels % 3 == 0 else 1
    for first in range(0, channels, several):
        group = part[..., first : first + several]
        if is_padded:
            group = cv2.cvtColor(group, cv2.COLOR_RGB2RGBA)
        sampled = cv2.remap(group, u, v, flag, borderMode=cv2.BORDER_WRAP)
        if is_padded:
            sampled = cv2.cvtColor(sampled, cv2.COLOR_RGBA2RGB)
        out[..., first : first + several] = sampled.reshape(*out.shape[:2], several)


def _write_polar(table: EquirectMap, image: NDArray[np.generic], out: NDArray[np.generic]) -> None:
    """Sample positions next to the poles, where cv2 would continue at the other pole."""
    u, v = (line.reshape(-1)[table.polar].astype(np.float64) for line in table[:2])
    v += table.part[0]
    v = np.where(v < 0, v, v - (len(image) - 2))
    values = _interpolated(image[[0, -1]], u + table.part[2], v)
    out.reshape(table.u.size, -1)[table.polar] = values.reshape(len(u), -1)


def _interpolated(image: NDArray[Any], u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.float64]:
    """Return float64 values ``(…[, C])`` of a whole or partial panorama ``(H, W[, C])``."""
    pixels = image.astype(np.float64)
    width = image.shape[1]
    beyond = [
        (np.roll(row, width // 2, 1) + np.roll(row, -(-width // 2), 1)) / 2
        for row in (pixels[:1], pixels[-1:])
    ]
    tall = np.concatenate([beyond[0], pixels, beyond[1]])
    framed = np.concatenate([tall[:, -1:], tall, tall[:, :1]], axis=1)
    x, y = np.where(u < width, u, u - width) + 1.0, v + 1.0
    column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    more = [1] * (image.ndim - 2)
    right, below = (share.reshape(*u.shape, *more) for share in (x - column, y - row))
    column, row = column.clip(0, width), row.clip(0, len(image))
    upper = framed[row, column] * (1 - right) + framed[row, column + 1] * right
    lower = framed[row + 1, column] * (1 - right) + framed[row + 1, column + 1] * right
    values: NDArray[np.float64] = upper * (1 - below) + lower * below
    return np.rint(values) if image.dtype.kind in "ui" else values


def check_interpolation(interpolation: str, blend: str = "nearest") -> None:
    """Raise SettingError unless the interpolation exists and can be combined with the blend."""
    check_choice("interpolation", interpolation, ("bilinear", "nearest"))
    if interpolation == "nearest" and blend != "nearest":
        raise SettingError(
            "interpolation",
            found=f"'nearest' with blend {blend!r}",
            expected="blend='nearest'",
            remedy="Copied pixels cannot be averaged.",
        )


def blend_of(blend: Blend, *, is_overlapping: bool) -> Blend:
    """Return the blend, or ``nearest`` for images that do not overlap.

    Images without overlap meet at their edges, where feather weights are 0: the faces of a cube map
    without a margin, and the panorama itself.

    Args:
        blend: Requested blend.
        is_overlapping: True if every pixel is inside an image, not only on its outer edge.

    Raises:
        SettingError: There is no such blend.
    """
    check_choice("blend", blend, ("nearest", "feather"))
    return blend if is_overlapping else "nearest"


def check_shape(shape: Sequence[int]) -> tuple[int, int]:
    """Return ``(H, W)`` as two integers; raise SettingError unless both are positive."""
    check_type("shape", shape, Iterable, "(height, width)")
    whole = [isinstance(side, int | np.integer) and side > 0 for side in shape]
    if len(whole) != 2 or not all(whole):
        raise SettingError("shape", found=tuple(shape), expected="(height, width), both 1 or more")
    return int(shape[0]), int(shape[1])


def check_array(name: str, images: object) -> None:
    """Raise TypeError unless images are an array or a tensor."""
    if not is_tensor(images):
        check_type(name, images, np.ndarray, "a NumPy array or a torch tensor")


def check_grid(grid: object) -> None:
    """Raise TypeError unless a grid is one."""
    check_type("grid", grid, PinholeGrid, "a grid, e.g. TangentGrid(base_level=1, level=9)")


def check_panorama(image: Tensor | NDArray[np.generic], interpolation: str) -> None:
    """Raise SettingError unless a panorama, array or tensor, can be sampled."""
    check_array("panorama", image)
    check_interpolation(interpolation)
    array = isinstance(image, np.ndarray)
    fits = image.ndim in (2, 3) and 0 not in image.shape if array else image.ndim >= 3
    if not fits or 0 in image.shape[-2:]:
        expected = "(H, W) or (H, W, C)" if array else "(..., C, H, W)"
        raise SettingError("panorama", found=f"shape {tuple(image.shape)}", expected=expected)
    _check_numbers("panorama", image, interpolation)


def check_images(
    name: str,
    images: Tensor | NDArray[np.generic],
    grid: PinholeGrid,
    interpolation: str = "bilinear",
) -> None:
    """Raise SettingError unless there is an image of the right size for each face of a grid.

    Args:
        name: Name of the images in the message.
        images: Tensor ``(..., N, C, h, w)`` or array ``(N, h, w[, C])``.
        grid: Geometry of the images.
        interpolation: Interpolation that will be used to sample them.
    """
    shape, sides = tuple(images.shape), (grid.num_images, *grid.size)
    if isinstance(images, np.ndarray):
        fits, expected = len(shape) in (3, 4) and shape[:3] == sides, "({}, {}, {}[, channels])"
    else:
        fits = len(shape) >= 4 and (shape[-4], *shape[-2:]) == sides
        expected = "(..., {}, channels, {}, {})"
    if not fits:
        raise SettingError(
            name,
            found=f"shape {shape}",
            expected=f"{expected.format(*sides)} for this grid",
            remedy="All images of the grid are needed, in its order.",
        )
    _check_numbers(name, images, interpolation)


def _check_numbers(name: str, values: Tensor | NDArray[np.generic], interpolation: str) -> None:
    if is_tensor(values):
        usable = interpolation == "nearest" or values.is_floating_point()
    else:
        usable = values.dtype.kind in ("uif" if interpolation == "bilinear" else "buif")
    if not usable:
        raise SettingError(
            name,
            found=f"dtype {values.dtype}",
            expected=f"numbers that {interpolation} interpolation can use",
            remedy="Convert them to floats, or use interpolation='nearest' for labels and masks.",
        )
