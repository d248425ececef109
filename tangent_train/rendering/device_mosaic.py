"""Class scores of a canvas, accumulated by torch on any device.

The same sums as in `kernels`, but with the classes first: ``(K, H, W)``. Each image covers a few
rectangles of the canvas, and each rectangle is sampled in one call.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

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

_PIXELS_AT_ONCE = 2**20
"""Number of pixels whose best class is determined at once."""

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


class DeviceSums:
    """Sums of probabilities, or labels, of a canvas on a device.

    Args:
        shape: ``(H, W)`` of the canvas.
        num_classes: K.
        device: A torch device.
        averaged: True to keep sums; False to keep only labels.

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
    ) -> None:
        self._shape = shape
        self._averaged = averaged
        self._num_classes = num_classes
        channels = num_classes if averaged else 0
        self.sums = torch.zeros((channels, *shape), dtype=torch.float32, device=device)
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
        if owner is None:
            scores = _softmax(scores)
        offsets_in = _offsets_in(geometry, scores)
        for m, number in enumerate(images.chosen.tolist()):
            for rows, columns in _boxes(spans[m], self._shape[1], scores.shape[1]):
                offsets = offsets_in(m, rows, columns)
                sampled = grid_sample(
                    scores[m : m + 1],
                    offsets.movedim(0, -1)[None].float(),
                    padding_mode="border",
                    align_corners=False,
                )[0]
                if owner is None:
                    weight = (1 - offsets.square()).clamp_(min=0).prod(dim=0).sqrt_().float()
                    self.sums[:, rows, columns].addcmul_(sampled, weight)
                    continue
                is_owner = owner[rows, columns] == number
                if self._averaged:
                    self.sums[:, rows, columns].addcmul_(
                        _softmax(sampled[None])[0], is_owner.float()
                    )
                else:
                    best = _without_nan(sampled).argmax(dim=0).int()
                    labels = self._labels[rows, columns]
                    labels.copy_(best.where(is_owner, labels))

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


def _offsets_in(canvas: CanvasGeometry, scores: Tensor) -> Callable[[int, slice, slice], Tensor]:
    """Return a function for the positions of canvas pixels in images ``(n, K, h, w)``.

    Returns:
        A function of an image, rows and columns. It returns ``(2, rows, columns)`` offsets from the
        center of the image in half image sides, and 2 for directions behind the image.
    """
    device, (height, width) = scores.device, scores.shape[-2:]
    dtype = torch.float32 if device.type == "mps" else torch.float64
    scaled = np.diag([2 / width, 2 / height, 1]) @ canvas.matrices
    scaled[:, :2] += np.array([[1 / width - 1], [1 / height - 1]]) * canvas.matrices[:, 2:]
    m, c, r = (
        torch.from_numpy(array).to(device, dtype, non_blocking=True)
        for array in (scaled, canvas.columns, canvas.rows)
    )
    with torch.autocast(device.type, enabled=False):
        of_columns, of_rows = m[:, :, None, :2] @ c, (m[:, :, 2:] * r[:, 1])[..., None]

    def offsets(image: int, rows: slice, columns: slice) -> Tensor:
        factors = r[rows, :1], of_columns[image, ..., columns]
        x, y, z = torch.addcmul(of_rows[image, :, rows], *factors)
        return (torch.stack([x, y]) / z).masked_fill_(z <= 0, 2)

    return offsets


def _boxes(spans: NDArray[np.int32], width: int, num_classes: int) -> Iterator[tuple[slice, slice]]:
    """Yield rows and columns of rectangles that contain the spans of an image.

    Args:
        spans: ``(H, 2)`` spans, see `CanvasGeometry`.
        width: Number of columns of the canvas.
        num_classes: K.
    """
    seen = np.flatnonzero(spans[:, 1])
    if not len(seen):
        return
    rows = np.arange(seen[0], seen[-1] + 1)
    # Near a pole an image may span all columns: bands of rows keep the rectangles tight.
    step = max(1, min(-(-len(rows) // 4), _SCORES_AT_ONCE // (num_classes * width)))
    for band in np.split(rows, range(step, len(rows), step)):
        inside = spans[band][spans[band, 1] > 0]
        if not len(inside):
            continue
        first = inside[:, 0].astype(int)
        # Relative to the first row, because other rows may begin on the other side of the seam.
        before = (first - first[0] + width // 2) % width - width // 2
        start, stop = int(before.min()), int((before + inside[:, 1]).max())
        start, count = int(first[0]) + start, min(stop - start, width)
        start = 0 if count == width else start % width
        inner = slice(int(band[0]), int(band[-1]) + 1)
        yield inner, slice(start, min(start + count, width))
        if start + count > width:
            yield inner, slice(0, start + count - width)


def _without_nan(scores: Tensor) -> Tensor:
    return scores.masked_fill(scores.isnan(), -torch.inf)


def _softmax(scores: Tensor) -> Tensor:
    """Return the softmax over the classes of ``(n, K, h, w)``; NaN gets probability 0."""
    return _without_nan(scores).softmax(dim=1).nan_to_num_(0.0)
