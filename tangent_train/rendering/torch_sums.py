"""Sums or labels of a canvas, accumulated by torch on any device; differentiable.

The same sums as in `kernels`, but with the channels first: ``(K, H, W)``. On a GPU every call takes
longer than its computation on few pixels, so the positions of all pixels that some images cover are
computed at once, and each image is sampled in one call.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.nn.functional import grid_sample

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.rendering.kernels import CanvasGeometry
    from tangent_train.rendering.representations.views import Views

    _Pixels = tuple[NDArray[np.int64], Callable[[Tensor, Tensor], Tensor]]
    """Pixels of the canvas, image after image: the number ``(n,)`` for each image, and a function
    that returns the flat indices of some of them, given their place in this list and their image.
    """

_SCORES_AT_ONCE = 2**25
"""Number of scores sampled in one call, 128 MiB."""

_PIXELS_AT_ONCE = 2**21
"""Number of pixels whose positions or best classes are determined at once."""

_SHARE = 4
"""On a GPU, sums take at most a quarter of the memory."""

_BYTES = 2**33
"""On other devices, sums take at most 8 GiB."""


def fits_on(device: torch.device | str, shape: tuple[int, int], num_classes: int) -> bool:
    """Return True if the sums of a canvas leave most of a device's memory to the network."""
    limit = _BYTES
    if torch.device(device).type == "cuda" and torch.cuda.is_available():
        limit = torch.cuda.get_device_properties(device).total_memory // _SHARE
    return 4 * num_classes * math.prod(shape) <= limit


class TorchSums:
    """Sums of a canvas, or the labels of the largest channels; see `Mosaic` for the arguments."""

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int,
        device: torch.device | str,
        dtype: torch.dtype,
        *,
        averaged: bool,
        softmax: bool,
    ) -> None:
        self._shape, self._channels, self._softmax = shape, channels, softmax
        size, pixels = channels if averaged else 0, math.prod(shape)
        self._sums = torch.zeros((size, pixels), dtype=dtype, device=device)
        self._labels = torch.zeros(pixels, dtype=torch.int32, device=device)
        self._owned: tuple[object, Tensor, NDArray[np.int64]] | None = None

    def add(self, values: Tensor, images: Views, *, is_feathered: bool) -> None:
        """Add some images, see `NumbaSums.add`.

        Args:
            values: ``(n, K, h, w)`` values of the images, on the device.
            images: Position of the images on the canvas.
            is_feathered: True to feather them, which needs sums; False to take each pixel from its
                owner.
        """
        geometry = images.geometry(self._shape, None)
        if is_feathered and self._softmax:
            values = _softmax(values, 1)
        offsets_at, by_image = _offsets_in(geometry, values), values.split(1)
        counts, flat_at = (
            _covered_pixels(geometry, values.device) if is_feathered else self._owned_pixels(images)
        )
        edges = np.concatenate([[0], counts.cumsum()])
        edges_there = _on_device(edges, values.device)
        at_once = max(1, min(_PIXELS_AT_ONCE, _SCORES_AT_ONCE // self._channels))
        for start in range(0, int(edges[-1]), at_once):
            stop = min(start + at_once, int(edges[-1]))
            places = torch.arange(start, stop, device=values.device)
            image = torch.searchsorted(edges_there, places, right=True) - 1
            flat = flat_at(places, image)
            offsets = offsets_at(image, flat)
            positions, weight = offsets.to(values.dtype).T[None, None], None
            if is_feathered:
                weight = (1 - offsets.square()).clamp_(min=0).prod(dim=0).sqrt_().to(values.dtype)
            limits = edges.clip(start, stop) - start
            for m in np.flatnonzero(np.diff(limits)).tolist():
                part = slice(int(limits[m]), int(limits[m + 1]))
                sampled = grid_sample(
                    by_image[m],
                    positions[:, :, part],
                    padding_mode="border",
                    align_corners=False,
                )
                sampled = sampled.view(self._channels, -1)
                self._add(sampled, flat[part], None if weight is None else weight[part])

    def _add(self, sampled: Tensor, index: Tensor, weight: Tensor | None) -> None:
        """Add values of one image to P different pixels of the canvas.

        Args:
            sampled: ``(K, P)`` values.
            index: ``(P,)`` flat indices of the pixels.
            weight: ``(P,)`` weights; None for pixels that the image owns.
        """
        if not len(self._sums):
            self._labels[index] = self._best(sampled, -torch.inf)[1].int()
            return
        if weight is not None:
            sampled = sampled * weight
        elif self._softmax:
            sampled = _softmax(sampled, 0)
        # The pixels are different, so the order of additions does not vary.
        self._sums.index_add_(1, index, sampled)

    def _best(self, scores: Tensor, floor: float) -> tuple[Tensor, Tensor]:
        """Return the largest of K scores and its index, which is K up to a floor."""
        highest, best = _without_nan(scores).max(dim=0)
        return highest, best.where(highest > floor, self._channels)

    def _owned_pixels(self, images: Views) -> _Pixels:
        """List the pixels that images own; the table is kept until images of another set follow."""
        device = self._sums.device
        if self._owned is None or self._owned[0] is not images.all_images:
            owner = images.owners(self._shape).ravel()
            order = _on_device(owner.argsort(kind="stable"), device)
            self._owned = images.all_images, order, np.bincount(owner, minlength=images.num_images)
        _, order, all_counts = self._owned
        counts = all_counts[images.chosen]
        first = (all_counts.cumsum() - all_counts)[images.chosen]
        shift = _on_device(first - (counts.cumsum() - counts), device)
        return counts, lambda places, image: order[places + shift[image]]

    def rows(self, rows: slice | NDArray[np.intp]) -> Tensor:
        """Return the sums ``(h, W, K)`` of some rows."""
        index = rows if isinstance(rows, slice) else rows.tolist()
        return self._sums.unflatten(1, self._shape)[:, index].movedim(0, -1)

    def labels(self, min_confidence: float) -> Tensor:
        """Return ``(H, W)`` indices of the best classes; K where the confidence is too low."""
        for start in range(0, math.prod(self._shape) if len(self._sums) else 0, _PIXELS_AT_ONCE):
            sums = self._sums[:, start : start + _PIXELS_AT_ONCE]
            highest, best = self._best(sums, 0.0 if self._softmax else -torch.inf)
            if min_confidence > 0:
                unsure = highest < min_confidence * sums.sum(dim=0)
                best = best.masked_fill(unsure, self._channels)
            self._labels[start : start + _PIXELS_AT_ONCE] = best
        dtype = torch.uint8 if self._channels < 256 else torch.uint16
        return self._labels.to(dtype).view(self._shape)


def _covered_pixels(canvas: CanvasGeometry, device: torch.device) -> _Pixels:
    """List the pixels that images may cover, from the spans of the geometry."""
    height, width = len(canvas.rows), canvas.columns.shape[1]
    first, counts = canvas.spans.astype(np.int64).reshape(-1, 2).T
    ends = counts.cumsum()
    shifts, ends_there = _on_device(first - (ends - counts), device), _on_device(ends, device)

    def flat_at(places: Tensor, image: Tensor) -> Tensor:
        del image
        line = torch.searchsorted(ends_there, places, right=True)
        return (line % height) * width + (places + shifts[line]) % width

    return counts.reshape(-1, height).sum(axis=1), flat_at


def _offsets_in(canvas: CanvasGeometry, values: Tensor) -> Callable[[Tensor, Tensor], Tensor]:
    """Return a function for the positions of P canvas pixels in images ``(n, K, h, w)``.

    Returns:
        A function that returns ``(2, P)`` offsets from the center of the image in half image sides,
        and 2 for directions behind the image, given images and flat indices ``(P,)``.
    """
    device, (height, width) = values.device, values.shape[-2:]
    scaled = np.diag([2 / width, 2 / height, 1]) @ canvas.matrices
    scaled[:, :2] += np.array([[1 / width - 1], [1 / height - 1]]) * canvas.matrices[:, 2:]
    dtype = np.float32 if device.type == "mps" else np.float64
    m, c, r = (
        _on_device(array.astype(dtype, copy=False), device)
        for array in (scaled.transpose(1, 0, 2), canvas.columns, canvas.rows)
    )
    with torch.autocast(device.type, enabled=False):
        of_columns, of_rows = (m[..., :2] @ c).flatten(1), (m[..., 2:] * r[:, 1]).flatten(1)

    def offsets(image: Tensor, flat: Tensor) -> Tensor:
        row, column = flat // c.shape[1], flat % c.shape[1]
        across = of_columns.index_select(1, image * c.shape[1] + column)
        down = of_rows.index_select(1, image * len(r) + row)
        xyz = torch.addcmul(down, r[:, 0].index_select(0, row), across)
        return (xyz[:2] / xyz[2]).masked_fill_(xyz[2] <= 0, 2)

    return offsets


def _on_device(array: NDArray[Any], device: torch.device) -> Tensor:
    """Copy an array to a device; a GPU is not waited for."""
    tensor = torch.from_numpy(np.ascontiguousarray(array))
    pinned = tensor.pin_memory() if device.type == "cuda" else tensor
    return pinned.to(device, non_blocking=True)


def _without_nan(scores: Tensor) -> Tensor:
    return scores.masked_fill(scores.isnan(), -torch.inf)


def _softmax(scores: Tensor, dim: int) -> Tensor:
    """Return the softmax over a dimension; NaN gets probability 0."""
    return _without_nan(scores).softmax(dim=dim).nan_to_num_(0.0)
