"""Panoramas as tensors: sampled and resized by torch on any device, differentiably.

A panorama is *framed* by one more row and column on each side, so that positions beyond its edges
are sampled like all others: longitude wraps, and a row beyond a pole is the row at the pole,
shifted by half a revolution.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch._compile import _disable_dynamo
from torch.nn.functional import embedding_bag, grid_sample

from tangent_train.rendering.forward import check_grid, check_panorama
from tangent_train.rendering.resampling import reduce_to_pitch
from tangent_train.rendering.tables import Value, cached, map_dtype, positions_of_pixels

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.geometry import PinholeGrid
    from tangent_train.geometry.grids import Faces
    from tangent_train.rendering.resampling import Interpolation


def exact(image: Tensor) -> Tensor:
    """Return an image as float64 if it is, else as float32."""
    return image if image.dtype == torch.float64 else image.float()


def on_device(array: NDArray[Any], device: torch.device) -> Tensor:
    """Copy an array to a device; a GPU is not waited for."""
    tensor = torch.from_numpy(np.ascontiguousarray(array))
    pinned = tensor.pin_memory() if device.type == "cuda" else tensor
    return pinned.to(device, non_blocking=True)


def cached_tensors(
    key: Hashable, build: Callable[[], Value], *, is_rotated: bool, device: torch.device
) -> Value:
    """Return a table of tensors, see `cached`; later uses may need gradients."""

    def build_normal() -> Value:
        with torch.inference_mode(False):
            return build()

    return cached(key, build_normal, is_rotated=is_rotated, device=device)


@_disable_dynamo  # NumPy and compiled kernels build the tables
def render_tensor(
    image: Tensor, grid: PinholeGrid, faces: Faces | None, interpolation: Interpolation
) -> Tensor:
    """Run `equirect_to_tangent` on a tensor."""
    check_panorama(image, interpolation)
    check_grid(grid)
    if interpolation == "bilinear":
        image = reduce_to_pitch(image, min(grid.pitches))
    positions = _positions(grid, image, grid.face_indices(faces), interpolation)
    planes = image.flatten(0, -3)
    if interpolation == "nearest":
        values = planes.flatten(-2).index_select(-1, positions.flatten())
        images = values.unflatten(-1, positions.shape).movedim(0, 1)
    else:
        images = _sampled(planes, positions)
    return images.unflatten(1, image.shape[:-2]).movedim(0, -4)


def _positions(
    grid: PinholeGrid, image: Tensor, faces: NDArray[np.int64], interpolation: Interpolation
) -> Tensor:
    """Return positions of the pixels of images, on the device of the panorama.

    The table of all images is kept; of rotated images, which change from sample to sample, that of
    the requested ones.

    Returns:
        ``(n, h, w, 2)`` positions for `_sampled`; or ``(n, h, w)`` flat int32 indices for
        ``nearest``.
    """
    shape, device = (image.shape[-2], image.shape[-1]), image.device
    dtype = map_dtype(image.dtype == torch.float64, interpolation)
    every = grid.face_indices()
    kept = every if grid.rotation is None else faces

    def build() -> tuple[Tensor]:
        columns, rows = positions_of_pixels(grid, shape, kept, dtype)
        u, v = (on_device(line.reshape(-1, *grid.size), device) for line in (columns, rows))
        if interpolation == "nearest":
            return (nearest_equirect_index(u, v, shape).int(),)
        return (_in_frame(u, v, shape),)

    key = "positions", device, shape, dtype, interpolation, tuple(kept.tolist())
    is_rotated = grid.rotation is not None
    table = cached_tensors((grid, *key), build, is_rotated=is_rotated, device=device)[0]
    if np.array_equal(kept, faces):
        return table
    return table.index_select(0, on_device(faces, device))


def sample_positions(
    image: Tensor, u: NDArray[Any], v: NDArray[Any], interpolation: Interpolation
) -> Tensor:
    """Return values ``(..., h, w)`` of a panorama ``(..., H, W)`` at positions ``(h, w)``."""
    columns, rows = (on_device(line, image.device) for line in (u, v))
    if interpolation == "nearest":
        index = nearest_equirect_index(columns, rows, (image.shape[-2], image.shape[-1]))
        return image.flatten(-2)[..., index]
    values = sample_tensor(image.flatten(0, -3), columns.flatten(), rows.flatten())
    return values.reshape(*image.shape[:-2], *u.shape)


def sample_tensor(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Interpolate a panorama bilinearly, differentiably on any device.

    Args:
        image: ``(C, H, W)`` floating-point values.
        u: ``(P,)`` columns in [−1, 2 W].
        v: ``(P,)`` rows in [−½, H − ½].

    Returns:
        ``(C, P)`` values of the dtype of the image.
    """
    shape = image.shape[-2], image.shape[-1]
    positions = _in_frame(u.where(u < shape[1], u - shape[1]), v, shape)
    return _sampled(image, positions[None, None])[0, :, 0]


def _in_frame(u: Tensor, v: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return positions ``(..., 2)`` in a framed panorama, −1 to 1 between its edges."""
    x, y = ((2 * at + 3) / (side + 2) - 1 for at, side in ((u, shape[1]), (v, shape[0])))
    return torch.stack([x, y], dim=-1)


def _sampled(image: Tensor, positions: Tensor) -> Tensor:
    """Return bilinear values ``(n, C, h, w)`` of a panorama at positions ``(n, h, w, 2)``."""
    framed = with_frame(exact(image))[None]
    count, given = len(positions), positions.to(framed.dtype)
    if framed.requires_grad:  # the gradient of an expanded tensor takes n times its memory
        given = given.flatten(0, 1)[None]
    else:
        framed = framed.expand(count, -1, -1, -1)
    with torch.autocast(image.device.type, enabled=False):
        values = grid_sample(framed, given, padding_mode="border", align_corners=False)
    if len(values) != count:
        values = values[0].unflatten(1, (count, -1)).movedim(1, 0)
    return values.to(image.dtype)


def with_frame(image: Tensor) -> Tensor:
    """Return a panorama ``(..., H, W)`` with its frame, ``(..., H + 2, W + 2)``."""
    above, below = _half_revolution(image[..., :1, :]), _half_revolution(image[..., -1:, :])
    tall = torch.cat([above, image, below], dim=-2)
    return torch.cat([tall[..., -1:], tall, tall[..., :1]], dim=-1)


def _half_revolution(row: Tensor) -> Tensor:
    """Return a row ``(..., 1, W)`` rotated by 180°; means of two columns if W is odd."""
    width = row.shape[-1]
    rotated = row.roll(width // 2, -1)
    return (rotated + row.roll(width // 2 + 1, -1)) / 2 if width % 2 else rotated


def nearest_equirect_index(u: Tensor, v: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return the nearest pixel at positions in an ERP; half-way between two, the even one.

    Args:
        u: Columns, any real number.
        v: Rows in [−½, H − ½], of the same shape.
        shape: ``(H, W)``.

    Returns:
        Flat indices, int64.
    """
    height, width = shape
    row = v.round().long().clamp(0, height - 1)
    return row * width + u.round().long() % width


def weigh_rows(image: Tensor, first: NDArray[np.int64], weights: NDArray[np.float64]) -> Tensor:
    """Return weighted sums of rows of an image.

    Args:
        image: ``(..., H, W)``.
        first: ``(h,)`` first row of each sum.
        weights: ``(taps, h)`` weights of this row and those below.

    Returns:
        ``(..., h, W)`` of the dtype of the image, float64 or float32.
    """
    rows = image.movedim(-2, 0)
    taps = (first + np.arange(len(weights))[:, None]).T.clip(0, len(rows) - 1)
    sums = embedding_bag(
        on_device(taps, image.device),
        rows.flatten(1),
        mode="sum",
        per_sample_weights=on_device(weights.T, image.device).to(image.dtype),
    )
    return sums.unflatten(1, rows.shape[1:]).movedim(0, -2)
