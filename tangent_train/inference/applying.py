"""Apply a function of images to a panorama, through its tangent images."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from tangent_train.checkpoints.kinds import Align, DepthKind
from tangent_train.errors import SettingError
from tangent_train.heads.alignment import AlignedMosaic
from tangent_train.rendering.backward import tangent_to_equirect
from tangent_train.rendering.checks import Blend, blend_of, check_panorama
from tangent_train.rendering.forward import Pixels, equirect_to_tangent
from tangent_train.rendering.mosaic import MeanMosaic
from tangent_train.rendering.representations.views import PinholeViews

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from tangent_train.geometry import PinholeGrid

_PIXELS_PER_CALL = 2**20


@torch.no_grad()
def apply(
    function: Callable[[Pixels], Pixels],
    panorama: Pixels,
    grid: PinholeGrid,
    blend: Blend = "feather",
    *,
    images_per_call: int | None = None,
    align: Align | None = None,
    kind: DepthKind | None = None,
) -> Pixels:
    """Apply a function of images to a panorama: scores, depth, features, masks.

    The images are rendered a few at a time with `equirect_to_tangent`, and their results are
    rendered back as with `tangent_to_equirect`. Besides the result, only the images of one call are
    held in memory. There are no gradients.

    With `align`, the results are depth. They are converted to distances along the rays and brought
    to one scale: views are compared, and blended, in the logarithm of distance, or for disparity in
    disparity along the ray. The depth of all images is held in memory.

    Args:
        function: Maps some images of the panorama's kind and dtype to a result of as many pixels:
            arrays ``(n, h, w[, C])`` to ``(n, h, w[, K])``, or tensors ``(n, C, h, w)`` to
            ``(n, h, w)`` or ``(n, K, h, w)``. Called with all images of the grid, in its order.
        panorama: An array ``(H, W[, C])``, or a floating-point tensor ``(C, H, W)``.
        grid: The images.
        blend: Blending of results that are floats, as in `tangent_to_equirect`. Whole numbers and
            booleans (labels, masks) need ``nearest``: each pixel is copied from its owner.
        images_per_call: Images per call of the function; None for as many as fit into 2^20 pixels.
        align: Correction of the depth of each image: ``scale``, ``affine`` (a scale and a shift),
            ``grid`` (also a coarse grid of scales) or ``none``. None for results that are not
            depth.
        kind: Kind of depth that the function returns, see `DepthKind`; only with `align`, which
            takes ``metric_z`` by default.

    Returns:
        An array ``(H, W[, K])``, or a tensor ``(H, W)`` or ``(K, H, W)`` on the panorama's device:
        float32 if the function returns floats, else the function's dtype. With `align`, distances
        ``(H, W)``, NaN where unknown: meters, or for relative kinds a median of 1, by solid angle.

    Raises:
        SettingError: The panorama or the blend cannot be used, or the function returns results of
            another kind or shape.

    >>> brightness = lambda images: images.mean(axis=-1)
    >>> from tangent_train.geometry import TangentGrid
    >>> apply(brightness, np.full((32, 64, 3), 0.5), TangentGrid(0, 4))[0, 0]
    np.float32(0.5)
    """
    blend = blend_of(blend, is_overlapping=grid.is_overlapping)
    check_panorama(panorama, "bilinear")
    step = images_per_call or max(1, _PIXELS_PER_CALL // math.prod(grid.size))
    rows, columns = panorama.shape[-2:] if isinstance(panorama, Tensor) else panorama.shape[:2]
    shape, views = (rows, columns), PinholeViews(grid)
    kept: list[NDArray[Any]] = []
    mosaic: Any = None
    if align is not None:
        mosaic = AlignedMosaic(shape, kind or "metric_z", blend, align)
    for faces in np.split(np.arange(grid.num_images), range(step, grid.num_images, step)):
        images = equirect_to_tangent(panorama, grid, faces)
        results = _as_array(function(images), images)
        _check_result(results, blend, align)
        if results.dtype.kind != "f":
            kept.append(results)
            continue
        flat = results.reshape(*results.shape[:3], -1).astype(np.float32)
        if mosaic is None:
            mosaic = MeanMosaic(shape, blend, flat.shape[-1], skips_unknown=False)
        part = views[faces[0] : faces[-1] + 1]
        mosaic.add(torch.from_numpy(np.moveaxis(flat, -1, 1)), part)
    if align is not None:
        array = mosaic.distances().numpy()
    elif mosaic is not None:
        array = mosaic.values().movedim(0, -1).reshape(*shape, *results.shape[3:]).numpy()
    else:
        array = tangent_to_equirect(np.concatenate(kept), grid, shape, interpolation="nearest")
    if not isinstance(panorama, Tensor):
        return array
    result = torch.from_numpy(array)
    return (result if array.ndim == 2 else result.movedim(-1, 0)).to(panorama.device)


def _check_result(results: NDArray[Any], blend: Blend, align: Align | None) -> None:
    """Refuse numbers that cannot be aligned or blended."""
    if align is not None:
        if (channels := math.prod(results.shape[3:])) != 1 or results.dtype.kind != "f":
            raise SettingError(
                "result of the function",
                found=f"K = {channels} of {results.dtype}",
                expected="one float per pixel, which is depth, with align=",
            )
    elif results.dtype.kind != "f" and blend != "nearest":
        raise SettingError(
            "blend",
            found=f"{blend!r} for results of {results.dtype}",
            expected="'nearest': labels and masks cannot be averaged",
            remedy="To average numbers, return them as floats.",
        )


def _as_array(returned: Any, images: Tensor | NDArray[Any]) -> NDArray[Any]:
    """Return the function's result for some images as an array ``(n, h, w[, K])``."""
    kind = Tensor if isinstance(images, Tensor) else np.ndarray
    count, (rows, columns) = len(images), images.shape[-2:] if kind is Tensor else images.shape[1:3]
    found = f"a {type(returned).__name__}"
    if isinstance(returned, kind):
        found = f"shape {tuple(returned.shape)} of {returned.dtype}"
        array: NDArray[Any] = returned  # type: ignore[assignment]
        if isinstance(returned, Tensor):
            array = (returned.float() if returned.is_floating_point() else returned).cpu().numpy()
            array = array if returned.ndim < 4 else np.moveaxis(array, 1, -1)
        fits = array.ndim in (3, 4) and array.shape[:3] == (count, rows, columns)
        if fits and array.dtype.kind in "buif":
            return array
    raise SettingError(
        "result of the function",
        found=found,
        expected=f"a {kind.__name__} of numbers for {count} images of {columns}×{rows} pixels",
    )
