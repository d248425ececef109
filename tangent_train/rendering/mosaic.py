"""Images combined on a canvas: class scores, depth or colors of one panorama or photo.

`tangent_to_equirect` and `tangent_to_labels` do it for all images of a grid at once.

A mosaic takes a few views at a time, from one or more sets, and does not keep them. There are two
backends with the same results: compiled kernels on the CPU (`numba_sums`), and torch on any device
(`torch_sums`), which can be differentiated.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch._compile import _disable_dynamo  # torch.compiler.disable would import the compiler now

from tangent_train.geometry.coverage import check_coverage
from tangent_train.rendering.forward import (
    Blend,
    blend_of,
    check_array,
    check_grid,
    check_images,
    check_interpolation,
    check_shape,
)
from tangent_train.rendering.numba_sums import NO_SUMS, NumbaSums
from tangent_train.rendering.representations.views import PinholeViews
from tangent_train.rendering.resampling import Interpolation, Pixels
from tangent_train.rendering.tables import nearest_pixels
from tangent_train.rendering.torch_sums import TorchSums, fits_on

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.geometry import PinholeGrid
    from tangent_train.rendering.representations.views import Views

_LEAST_TOTAL = 1e-37
_PIXELS_AT_ONCE = 1 << 17

_LEAST_VALID = {"nearest": 0.5, "feather": 1e-3}
"""Least weight of the valid images at a pixel; of a single image, feather weights are 0 to 1."""

Backend = Literal["numba", "torch"] | None


class Mosaic:
    """Weighted sums of K channels of images at every pixel of a panorama or photo.

    Args:
        shape: ``(H, W)`` of the panorama or photo.
        channels: K.
        blend: Blend of the images: ``nearest``: a pixel takes the value of the image that owns it.
            ``feather``: the weighted sum of all images that cover it; see `blend_of`.
        averaged: True to keep sums. They take 4 K bytes per pixel; on the CPU K is rounded up to a
            multiple of 16, and sums beyond 2 GiB are kept in a temporary file (in the folder
            TMPDIR). False to keep only labels.
        softmax: True to add the softmax of the channels.
        device: Device of the mosaic; sums that are too large for it are kept on the CPU.
        backend: ``numba`` on the CPU, or ``torch``; None to choose by device.
        dtype: dtype of the sums of the backend ``torch``.
        spare: `sums` of a mosaic that is no longer used, to reuse its memory on the CPU.

    Raises:
        SettingError: The temporary file for the sums does not fit on the disk.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int,
        blend: Blend,
        *,
        averaged: bool = True,
        softmax: bool = False,
        device: torch.device | str = "cpu",
        backend: Backend = None,
        dtype: torch.dtype = torch.float32,
        spare: NDArray[np.float32] | None = None,
    ) -> None:
        self.shape, self._dtype = shape, dtype
        self.blend: Blend = blend
        if backend is None:
            is_suitable = torch.device(device).type != "cpu" and fits_on(device, shape, channels)
            backend = "torch" if is_suitable else "numba"
        settings = {"averaged": averaged, "softmax": softmax}
        self._backend: NumbaSums | TorchSums
        if backend == "torch":
            self._backend = TorchSums(shape, channels, device, dtype, **settings)
        else:
            self._backend = NumbaSums(shape, channels, spare, **settings)

    @property
    def sums(self) -> NDArray[np.float32]:
        """Sums on the CPU, see `NumbaSums`; empty if they are not kept or on another device."""
        return self._backend.sums if isinstance(self._backend, NumbaSums) else NO_SUMS

    def add(self, values: Tensor, views: Views) -> None:
        """Add some views of a set; each view of the set must be added once.

        Args:
            values: ``(n, K, h, w)`` scores, not probabilities; or other values.
            views: The views.
        """
        images, views = views.on_canvas(values.to(self._dtype), self.shape)
        is_feathered = blend_of(self.blend, is_overlapping=views.is_overlapping) == "feather"
        self._backend.add(images, views, is_feathered=is_feathered)

    def labels(self) -> Tensor:
        """Return ``(H, W)`` indices of the largest channels (the first of equals)."""
        return self._backend.labels(0)


class ScoreMosaic(Mosaic):
    """Class scores at every pixel of a panorama or photo.

    Args:
        shape: ``(H, W)`` of the panorama or photo.
        num_classes: K.
        blend: Blend of the images: ``nearest`` interpolates scores, ``feather`` averages
            probabilities.
        averaged: True to keep sums of probabilities, which `probabilities` and several sets of
            views need. They are always kept with ``feather`` and with `min_confidence`.
        min_confidence: Confidence below which a pixel has no class.
        **settings: `device`, `backend` and `spare`, see `Mosaic`.

    Attributes:
        has_probabilities: True if sums of probabilities are kept.

    Raises:
        SettingError: See `Mosaic`.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        num_classes: int,
        blend: Blend,
        *,
        averaged: bool = False,
        min_confidence: float = 0.0,
        **settings: Any,
    ) -> None:
        averaged = averaged or blend == "feather" or min_confidence > 0
        settings |= {"averaged": averaged, "softmax": True}
        super().__init__(shape, num_classes, blend, **settings)
        self._min_confidence = min_confidence
        self.has_probabilities = averaged

    @property
    def not_finite(self) -> Tensor:
        """Share of the pixels at which a view has a score that is NaN or infinite."""
        return self._backend.unknown() / math.prod(self.shape)

    def labels(self) -> Tensor:
        """Return ``(H, W)`` indices of the best classes (the first of equals).

        They are K where the confidence is too low, and where a view has no softmax because a score
        is NaN or infinite. The scores of networks in half precision overflow beyond 65504.
        """
        return self._backend.labels(self._min_confidence)

    def probabilities(self, rows: slice | NDArray[np.intp]) -> Tensor:
        """Return ``(h, W, K)`` probabilities of some rows; needs `averaged`.

        They add up to 1; all are 0 where a view has no softmax.
        """
        total = self._backend.rows(rows)
        return (total / total.sum(dim=-1, keepdim=True).clamp(min=_LEAST_TOTAL)).nan_to_num_(0.0)

    def confidences(self) -> NDArray[np.float32]:
        """Return the ``(H, W)`` probabilities of the best classes; needs `averaged`."""
        step = max(1, _PIXELS_AT_ONCE // self.shape[1])
        starts = range(0, self.shape[0], step)
        parts = [self.probabilities(slice(top, top + step)).amax(dim=-1) for top in starts]
        return torch.cat(parts).cpu().numpy()


class MeanMosaic(Mosaic):
    """Weighted means of K channels of images, such as depth or colors.

    One more channel sums the weights.

    Args:
        shape: ``(H, W)`` of the panorama or photo.
        blend: Blend of the images.
        channels: K.
        skips_unknown: True if pixels with a value that is not finite do not count. False if they
            make all results that depend on them NaN.
        **settings: `device`, `backend` and `dtype`, see `Mosaic`.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        blend: Blend,
        channels: int = 1,
        *,
        skips_unknown: bool = True,
        **settings: Any,
    ) -> None:
        super().__init__(shape, channels + 1, blend, **settings)
        self._skips_unknown = skips_unknown

    def add(self, values: Tensor, views: Views) -> None:
        """Add some views ``(n, K, h, w)`` of a set."""
        weights = torch.ones_like(values[:, :1])
        if self._skips_unknown:
            valid = values.isfinite().all(dim=1, keepdim=True)
            values, weights = values.where(valid, 0), valid.to(values.dtype)
        super().add(torch.cat([values, weights], dim=1), views)

    def values(self) -> Tensor:
        """Return the ``(K, H, W)`` means; NaN where no image has a value."""
        sums = self._backend.rows(slice(None)).movedim(-1, 0)
        least = _LEAST_VALID[self.blend] if self._skips_unknown else 0
        return (sums[:-1] / sums[-1]).where(sums[-1] >= least, torch.nan)


def blend_back(grid: PinholeGrid, blend: Blend) -> Blend:
    """Return the blend of images that cover the sphere, see `blend_of`.

    Raises:
        SettingError: There is no such blend, or the images miss a direction.
    """
    blend = blend_of(blend, is_overlapping=grid.is_overlapping)
    if not grid.is_complete:
        remedy = "Rendering back needs a larger fov or more views."
        check_coverage([grid], by_owners=blend == "nearest", remedy=remedy)
    return blend


@_disable_dynamo
def tangent_to_equirect(
    images: Pixels,
    grid: PinholeGrid,
    shape: tuple[int, int],
    blend: Blend = "nearest",
    interpolation: Interpolation = "bilinear",
) -> Pixels:
    """Render tangent images back to a panorama.

    Args:
        images: All images of the grid: a floating-point tensor ``(..., N, C, h, w)`` on any
            device, differentiable; or an array ``(N, h, w[, C])`` of numbers.
        grid: The images' geometry.
        shape: ``(H, W)`` of the panorama.
        blend: ``nearest``: every direction is taken from its owner. ``feather``: the average of
            all images that cover it, with weights that fall to 0 at the images' borders, so that
            there are no seams. See `blend_of` for images that do not overlap.
        interpolation: ``bilinear``; or ``nearest`` for labels, masks and depth of any dtype, which
            copies the nearest pixel of the owner and needs the blend ``nearest``.

    Returns:
        A tensor ``(..., C, H, W)`` or an array ``(H, W[, C])``, of the dtype of the images.

    Raises:
        SettingError: The images, the shape, the blend or the interpolation cannot be used, or the
            images do not cover the sphere.
    """
    check_array("tangent images", images)
    check_grid(grid)
    blend = blend_back(grid, blend)
    check_interpolation(interpolation, blend)
    shape = check_shape(shape)
    check_images("tangent images", images, grid, interpolation)
    if interpolation == "nearest":
        index = nearest_pixels(grid, shape)
        if isinstance(images, np.ndarray):
            return images.reshape(-1, *images.shape[3:])[index]
        pixels = images.movedim(-4, -3).flatten(-3)
        return pixels[..., torch.from_numpy(index).to(images.device)]
    if isinstance(images, np.ndarray):
        return _from_arrays(images, grid, shape, blend)
    flat = images.reshape(-1, *images.shape[-4:]).movedim(0, 1).flatten(1, 2)
    result = _means(flat, grid, shape, blend).to(images.dtype)
    return result.reshape(*images.shape[:-4], images.shape[-3], *shape)


@_disable_dynamo
def tangent_to_labels(
    logits: Pixels, grid: PinholeGrid, shape: tuple[int, int], blend: Blend = "nearest"
) -> Pixels:
    """Return the class of the largest bilinear score at every pixel of the panorama.

    Rendering and argmax are one step, so the scores of the panorama, ``(K, H, W)``, are not held in
    memory, except on a GPU with the blend ``feather``. All scores are rendered in float32.

    Args:
        logits: ``(..., N, K, h, w)`` floating-point scores of all images of the grid.
        grid: The images' geometry.
        shape: ``(H, W)`` of the panorama.
        blend: ``nearest``: the owner's scores. ``feather``: the average of all images that cover a
            direction, weighted as in `tangent_to_equirect`; meant for probabilities.

    Returns:
        ``(..., H, W)`` class indices. The first of several equal scores wins. The index is K where
        a score is NaN or infinite.
        An int64 tensor on the device of the logits, or an array, uint8 below 256 classes and else
        uint16.

    Raises:
        SettingError: The logits, the shape or the blend cannot be used.
    """
    check_array("scores", logits)
    check_grid(grid)
    scores = _tensor(logits) if isinstance(logits, np.ndarray) else logits.detach()
    blend = blend_back(grid, blend)
    shape = check_shape(shape)
    check_images("scores", scores, grid)
    labels: list[Tensor] = []
    for stack in scores.reshape(-1, *scores.shape[-4:]):
        mosaic = Mosaic(
            shape,
            stack.shape[1],
            blend,
            averaged=False,
            device=scores.device,
            backend="numba" if scores.device.type == "cpu" else "torch",
        )
        mosaic.add(stack, PinholeViews(grid))
        labels.append(mosaic.labels())
    if isinstance(logits, np.ndarray):
        return torch.stack(labels).reshape(*scores.shape[:-4], *shape).numpy()
    empty = torch.zeros((0, *shape), dtype=torch.int64, device=scores.device)
    found = torch.cat([empty, *(part.long()[None] for part in labels)])
    return found.reshape(*scores.shape[:-4], *shape)


def _tensor(array: NDArray[np.generic]) -> Tensor:
    """Return a tensor that shares the array's memory, or a copy if the array is read-only."""
    array = np.ascontiguousarray(array)
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def _means(images: Tensor, grid: PinholeGrid, shape: tuple[int, int], blend: Blend) -> Tensor:
    """Return the means ``(C, H, W)`` of images ``(N, C, h, w)``, differentiably."""
    is_exact = images.dtype == torch.float64
    is_simple = images.device.type == "cpu" and not (images.requires_grad or is_exact)
    backend: Backend = "numba" if is_simple else "torch"
    mosaic = MeanMosaic(
        shape,
        blend,
        images.shape[1],
        skips_unknown=False,
        device=images.device,
        backend=backend,
        dtype=torch.float64 if is_exact else torch.float32,
    )
    mosaic.add(images, PinholeViews(grid))
    return mosaic.values()


def _from_arrays(
    images: NDArray[Any], grid: PinholeGrid, shape: tuple[int, int], blend: Blend
) -> NDArray[Any]:
    """Run `tangent_to_equirect` on arrays ``(N, h, w[, C])``; integer results are rounded."""
    is_exact = images.dtype == np.float64 or images.dtype in (np.int32, np.uint32, np.int64)
    stack = _tensor(images.astype(np.float64 if is_exact else np.float32, copy=False))
    stack = stack[:, None] if images.ndim == 3 else stack.movedim(-1, 1)
    result = _means(stack, grid, shape, blend).movedim(0, -1).numpy()
    if images.dtype.kind in "ui":
        result = np.rint(result)
    return np.ascontiguousarray(result.reshape(*shape, *images.shape[3:]), images.dtype)
