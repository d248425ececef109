"""Class scores or values of a canvas, accumulated by torch on any device.

The same sums as in `kernels`, but with the classes first: ``(K, H, W)``. On a GPU every call takes
longer than its computation on few pixels, so the positions of all pixels that some images cover are
computed at once, and each image is sampled in one call.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import grid_sample

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.rendering.kernels import CanvasGeometry
    from tangent_train.rendering.representations.views import Views

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


class _CanvasPixels(NamedTuple):
    """Pixels of the canvas that images cover, ``(P,)`` each.

    Attributes:
        image: Index of the image, 0 … n − 1.
        row: Row of the canvas.
        column: Column of the canvas.
        flat: Flat index into the canvas.
    """

    image: Tensor
    row: Tensor
    column: Tensor
    flat: Tensor


class DeviceSums:
    """Sums of probabilities, or labels, of a canvas on a device.

    Args:
        shape: ``(H, W)`` of the canvas.
        num_classes: K.
        device: A torch device.
        averaged: True to keep sums; False to keep only labels.
        softmax: True to add probabilities; False to add the scores.

    Attributes:
        sums: ``(K, H, W)`` float32; ``(0, H, W)`` if they are not kept.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        num_classes: int,
        device: torch.device | str,
        *,
        averaged: bool,
        softmax: bool = True,
    ) -> None:
        self._shape = shape
        self._averaged = averaged
        self._softmax = softmax
        self._num_classes = num_classes
        channels = num_classes if averaged else 0
        self.sums = torch.zeros((channels, *shape), dtype=torch.float32, device=device)
        self._sums = self.sums.flatten(1)
        self._labels = torch.zeros(shape, dtype=torch.int32, device=device)

    def add(self, scores: Tensor, images: Views, owner: Tensor | None) -> None:
        """Add the scores of some images.

        Args:
            scores: ``(n, K, h, w)`` float32 scores, on the device.
            images: Place of the images on the canvas.
            owner: ``(H, W)`` image that owns each pixel; None for feathering.
        """
        height, _ = self._shape
        geometry = images.geometry(self._shape, slice(0, height), np.empty((0, 0), np.uint8))
        spans = geometry.spans if owner is None else images.owned_spans(self._shape)
        if owner is None and self._softmax:
            scores = _softmax(scores)
        numbers = _on_device(images.chosen, scores.device)
        offsets_at = _offsets_in(geometry, scores)
        for runs in _parts(spans, scores.shape[1]):
            pixels = _pixels_of(runs, self._shape, scores.device)
            offsets = offsets_at(pixels)
            if owner is None:
                weight = (1 - offsets.square()).clamp_(min=0).prod(dim=0).sqrt_().float()
            else:
                owners = owner.view(-1).index_select(0, pixels.flat)
                weight = owners == numbers.index_select(0, pixels.image)
            positions = offsets.float().T[None, None]
            for m, part in _by_image(runs):
                sampled = grid_sample(
                    scores[m : m + 1],
                    positions[:, :, part],
                    padding_mode="border",
                    align_corners=False,
                )
                self._add(sampled, pixels.flat[part], weight[part], is_owner=owner is not None)

    def _add(self, sampled: Tensor, index: Tensor, weight: Tensor, *, is_owner: bool) -> None:
        """Add scores or probabilities ``(1, K, 1, P)`` of one image to P pixels of the canvas."""
        if self._averaged:
            sampled = _softmax(sampled) if is_owner and self._softmax else sampled
            # The pixels of an image are distinct, so the order of additions does not vary.
            self._sums.index_add_(1, index, sampled[0, :, 0].mul_(weight))
            return
        best, labels = _without_nan(sampled)[0, :, 0].argmax(dim=0).int(), self._labels.view(-1)
        labels[index] = best.where(weight, labels[index])

    def labels(self, min_confidence: float) -> Tensor:
        """Return ``(H, W)`` indices of the best classes; K where the confidence is too low."""
        if self._averaged:
            step = max(1, _PIXELS_AT_ONCE // self._shape[1])
            for start in range(0, self._shape[0], step):
                sums = self.sums[:, start : start + step]
                highest, best = sums.max(dim=0)
                if min_confidence > 0:
                    unsure = highest < min_confidence * sums.sum(dim=0)
                    best = best.masked_fill(unsure, self._num_classes)
                self._labels[start : start + step] = best
        return self._labels.to(torch.uint8 if self._num_classes < 256 else torch.uint16)


def _parts(spans: NDArray[np.int32], num_classes: int) -> Iterator[NDArray[np.int64]]:
    """Divide spans into runs of canvas pixels that are sampled at once.

    Args:
        spans: ``(n, H, 2)`` spans, see `CanvasGeometry`.
        num_classes: K.

    Yields:
        ``(R, 4)`` runs: index of the image, row, first column and number of columns.
    """
    image, row = np.nonzero(spans[..., 1])
    if not len(row):  # such images own no pixel
        return
    runs = np.column_stack([image, row, spans[image, row]]).astype(np.int64)
    at_once = max(1, min(_PIXELS_AT_ONCE, _SCORES_AT_ONCE // num_classes))
    part = (np.cumsum(runs[:, 3]) - 1) // at_once
    yield from np.split(runs, np.flatnonzero(np.diff(part)) + 1)


def _by_image(runs: NDArray[np.int64]) -> Iterator[tuple[int, slice]]:
    """Yield the index of each image of some runs, and the slice of its pixels."""
    edges = np.flatnonzero(np.diff(runs[:, 0], prepend=-1, append=-1))
    ends = np.cumsum(runs[:, 3])
    start = 0
    for first, after in pairwise(edges.tolist()):
        stop = int(ends[after - 1])
        yield int(runs[first, 0]), slice(start, stop)
        start = stop


def _pixels_of(
    runs: NDArray[np.int64], shape: tuple[int, int], device: torch.device
) -> _CanvasPixels:
    """List the pixels of some runs on a device.

    Args:
        runs: See `_parts`.
        shape: ``(H, W)`` of the canvas.
        device: Device of the result.
    """
    stops = np.cumsum(runs[:, 3])
    shifted = runs[:, 2] - (stops - runs[:, 3])
    table = np.stack([runs[:, 0], runs[:, 1], shifted, runs[:, 3]])
    image, row, shift, count = _on_device(table, device)
    total = int(stops[-1])
    run = torch.repeat_interleave(count, output_size=total)
    row = row.index_select(0, run)
    column = (torch.arange(total, device=device) + shift.index_select(0, run)) % shape[1]
    return _CanvasPixels(image.index_select(0, run), row, column, row * shape[1] + column)


def _offsets_in(canvas: CanvasGeometry, scores: Tensor) -> Callable[[_CanvasPixels], Tensor]:
    """Return a function for the positions of P canvas pixels in images ``(n, K, h, w)``.

    Returns:
        A function that returns ``(2, P)`` offsets from the center of the image in half image sides,
        and 2 for directions behind the image.
    """
    device, (height, width) = scores.device, scores.shape[-2:]
    scaled = np.diag([2 / width, 2 / height, 1]) @ canvas.matrices
    scaled[:, :2] += np.array([[1 / width - 1], [1 / height - 1]]) * canvas.matrices[:, 2:]
    dtype = np.float32 if device.type == "mps" else np.float64
    m, c, r = (
        _on_device(array.astype(dtype, copy=False), device)
        for array in (scaled.transpose(1, 0, 2), canvas.columns, canvas.rows)
    )
    with torch.autocast(device.type, enabled=False):
        of_columns, of_rows = (m[..., :2] @ c).flatten(1), (m[..., 2:] * r[:, 1]).flatten(1)

    def offsets(pixels: _CanvasPixels) -> Tensor:
        across = of_columns.index_select(1, pixels.image * c.shape[1] + pixels.column)
        down = of_rows.index_select(1, pixels.image * len(r) + pixels.row)
        xyz = torch.addcmul(down, r[:, 0].index_select(0, pixels.row), across)
        return (xyz[:2] / xyz[2]).masked_fill_(xyz[2] <= 0, 2)

    return offsets


def _on_device(array: NDArray[Any], device: torch.device) -> Tensor:
    """Copy an array to a device; a GPU is not waited for."""
    tensor = torch.from_numpy(np.ascontiguousarray(array))
    pinned = tensor.pin_memory() if device.type == "cuda" else tensor
    return pinned.to(device, non_blocking=True)


def _without_nan(scores: Tensor) -> Tensor:
    return scores.masked_fill(scores.isnan(), -torch.inf)


def _softmax(scores: Tensor) -> Tensor:
    """Return the softmax over the classes of ``(n, K, h, w)``; NaN gets probability 0."""
    return _without_nan(scores).softmax(dim=1).nan_to_num_(0.0)
