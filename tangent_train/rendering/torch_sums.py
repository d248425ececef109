"""Sums or labels of a canvas, computed by torch on any device; differentiable.

The same sums as in `kernels`. They are one product of a sparse matrix with the values of all views:
every pixel of the canvas is a weighted sum of four pixels of each view that it is taken from. The
matrix depends on the views and the size of the canvas only, so it is kept for the next panoramas.
The channels of a pixel are adjacent in memory, and `embedding_bag` adds them without a copy of the
single terms.
"""

from __future__ import annotations

import itertools
import math
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch.nn.functional import embedding_bag

from tangent_train.rendering.tensors import cached_tensors, on_device

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

    from tangent_train.rendering.representations.views import Views

_ENTRIES_AT_ONCE = 2**25
"""Largest number of entries of a matrix, 256 MiB; a canvas with more is divided by rows."""

_SCORES_AT_ONCE = 2**29
"""Number of sums that are held at once if only labels are kept, 2 GiB."""

_PIXELS_AT_ONCE = 2**21
"""Number of pixels whose positions are computed at once."""

_SHARE = 8
"""On a GPU, sums take at most an eighth of the memory; the values of the views take more."""

_BYTES = 2**32
"""On other devices, sums take at most 4 GiB."""

_NEVER = -1e30
"""Stands for a score of minus infinity, whose product with a weight of 0 would be NaN."""

_LARGEST = 1e20
"""Scores beyond it are infinite, or weighted sums with `_NEVER`."""


def fits_on(device: torch.device | str, shape: tuple[int, int], num_classes: int) -> bool:
    """Return True if the sums of a canvas leave most of a device's memory to the network."""
    limit = _BYTES
    if torch.device(device).type == "cuda" and torch.cuda.is_available():
        limit = torch.cuda.get_device_properties(device).total_memory // _SHARE
    return 4 * num_classes * math.prod(shape) <= limit


class Taps(NamedTuple):
    """A sparse matrix: the pixels of views whose weighted sums are the pixels of a canvas.

    Attributes:
        source: ``(E,)`` flat indices of pixels of the views ``(N, h, w)``, int32; N h w where a
            view may cover the pixel of the canvas, but does not.
        weight: ``(E,)`` weights.
        first: ``(P + 1,)`` first entry of each pixel of the canvas, and E; int32.
    """

    source: Tensor
    weight: Tensor
    first: Tensor

    def sums(self, values: Tensor) -> Tensor:
        """Return the sums ``(P, K)`` of values ``(N h w + 1, K)``: pixels of views, and zeros."""
        source, weight, first = self
        how: Any = {"mode": "sum", "per_sample_weights": weight, "include_last_offset": True}
        return embedding_bag(source, values, first, **how)

    def transposed(self, count: int) -> Taps:
        """Return the transposed matrix, with one row for each of `count` values."""
        index, order = self.source.sort(stable=True)
        numbers = torch.arange(max(len(index), count + 1), dtype=torch.int32, device=index.device)
        first = torch.searchsorted(index, numbers[: count + 1], out_int32=True)
        entries = numbers[: len(index)]
        pixel = torch.searchsorted(self.first, entries, right=True, out_int32=True) - 1
        return Taps(pixel[order], self.weight[order], first)


class _Product(torch.autograd.Function):
    """Product with a sparse matrix; the gradient of `embedding_bag` takes much longer."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, taps: Taps, back: Taps) -> Tensor:
        """Return the sums."""
        ctx.taps, ctx.back = taps, back
        return taps.sums(values)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        """Return the product with the transposed matrix."""
        return _Product.apply(gradient.contiguous(), ctx.back, ctx.taps), None, None


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
        self._shape, self._channels, self._dtype = shape, channels, dtype
        self._averaged, self._softmax, self._device = averaged, softmax, device
        self._sums: Tensor | None = None
        self._labels = torch.zeros(math.prod(shape), dtype=self._label_dtype, device=device)
        self._views: Views | None = None
        self._rows = self._values = self._labels
        self._missing = np.zeros(0, np.bool_)
        self._is_feathered = False

    @property
    def _label_dtype(self) -> torch.dtype:
        return torch.uint8 if self._channels < 256 else torch.uint16

    def add(self, values: Tensor, images: Views, *, is_feathered: bool) -> None:
        """Add some images, see `NumbaSums.add`; all images of a set are summed at once.

        Args:
            values: ``(n, K, h, w)`` values of the images, on the device.
            images: Position of the images on the canvas.
            is_feathered: True to feather them, which needs sums; False to take each pixel from its
                owner.
        """
        if self._views is None or self._views.key != images.key:
            self._finish()
            self._views, self._is_feathered = images.whole, is_feathered
            size = images.num_images, *values.shape[2:]
            rows = (math.prod(size) + 1, self._channels)
            self._rows = torch.empty(rows, dtype=self._dtype, device=values.device)
            self._rows[-1] = 0
            self._values = self._rows[:-1].unflatten(0, size)
            self._missing = np.ones(images.num_images, np.bool_)
        chosen, given = _as_slice(images.chosen), values.movedim(1, -1)
        part = self._values[chosen]  # a copy, unless they are consecutive
        if self._softmax and is_feathered:
            torch.softmax(given, -1, dtype=self._dtype, out=part)
        elif self._softmax or not self._averaged:
            torch.clamp(given, min=_NEVER, out=part)
        else:
            part.copy_(given)
        if not isinstance(chosen, slice):
            self._values[chosen] = part
        self._missing[images.chosen] = False
        if not self._missing.any():
            self._finish()

    def _finish(self) -> None:
        """Sum the images of a set up."""
        if self._views is None:
            return
        views, values, self._views = self._views, self._rows, None
        if self._missing.any():
            self._values[np.flatnonzero(self._missing).tolist()] = 0
        size, self._rows = (self._values.shape[1], self._values.shape[2]), self._labels
        self._values = self._labels
        matrix = _Matrix(views, self._shape, size, values, self._is_feathered)
        if not self._averaged:
            count = math.ceil(self._channels * math.prod(self._shape) / _SCORES_AT_ONCE)
            best = (self._best(matrix.sums(values, part)) for part in matrix.parts(count))
            self._labels = _joined(list(best))
            return
        sums = _joined([matrix.sums(values, part) for part in matrix.parts()])
        if self._softmax and not self._is_feathered:
            are_lost = sums.amax(dim=-1, keepdim=True) < -_LARGEST  # all are minus infinity
            sums = sums.masked_fill(are_lost, math.nan).softmax(-1)
        self._sums = sums if self._sums is None else self._sums + sums

    def _best(self, scores: Tensor, min_confidence: float = 0.0) -> Tensor:
        """Return the index of the largest of K scores or sums of probabilities ``(P, K)``, or K."""
        highest, best = scores.max(dim=-1)  # NaN if one is NaN
        known = highest > 0 if self._averaged else highest.abs() < _LARGEST
        if min_confidence > 0:
            known &= highest >= min_confidence * scores.sum(dim=-1)
        return best.where(known, self._channels).to(self._label_dtype)

    def _total(self) -> Tensor:
        """Return the sums ``(H W, K)`` of all images that were added."""
        self._finish()
        if self._sums is None:
            size = (math.prod(self._shape), self._channels)
            self._sums = torch.zeros(size, dtype=self._dtype, device=self._device)
        return self._sums

    def unknown(self) -> Tensor:
        """Return the number of pixels at which a view has a score that is NaN or infinite."""
        self._finish()
        if self._averaged:
            return self._total()[:, 0].isnan().sum()
        return (self._labels == self._channels).sum()

    def rows(self, rows: slice | NDArray[np.intp]) -> Tensor:
        """Return the sums ``(h, W, K)`` of some rows."""
        index = rows if isinstance(rows, slice) else rows.tolist()
        return self._total().view(*self._shape, self._channels)[index]

    def labels(self, min_confidence: float) -> Tensor:
        """Return ``(H, W)`` indices of the best classes; K where the confidence is too low."""
        self._finish()
        if self._averaged:
            self._labels = self._best(self._total(), min_confidence)
        return self._labels.view(self._shape)


class _Matrix:
    """The sparse matrix from the views of a set to a canvas, in a cache of limited size.

    Args:
        views: All N views.
        shape: ``(H, W)`` of the canvas.
        size: Rows and columns of a view.
        values: ``(N h w + 1, K)`` values, which determine device and dtype.
        is_feathered: See `TorchSums.add`.
    """

    def __init__(
        self,
        views: Views,
        shape: tuple[int, int],
        size: tuple[int, int],
        values: Tensor,
        is_feathered: bool,
    ) -> None:
        self._views, self._shape, self._size = views, shape, size
        self._device, self._dtype = values.device, values.dtype
        self._canvas = views.geometry(shape, None if is_feathered else views.owners(shape))
        self._count, self._is_feathered = len(values), is_feathered

    def parts(self, least: int = 1) -> list[tuple[int, int]]:
        """Return the first row of each part of the canvas, and the row after the last."""
        pixels = self._canvas.spans[..., 1].sum() if self._is_feathered else math.prod(self._shape)
        count = max(least, math.ceil(4 * int(pixels) / _ENTRIES_AT_ONCE))
        edges = np.linspace(0, self._shape[0], count + 1).astype(int).tolist()
        return list(itertools.pairwise(edges))

    def sums(self, values: Tensor, part: tuple[int, int]) -> Tensor:
        """Return the sums ``(P, K)`` of some rows of the canvas."""
        build = self._feathered if self._is_feathered else self._owned
        key = (
            "taps",
            self._views.key,
            self._shape,
            self._size,
            self._dtype,
            self._is_feathered,
            part,
        )
        where: Any = {"is_rotated": self._views.is_rotated, "device": self._device}
        taps = cached_tensors(key, lambda: build(*part), **where)
        if not values.requires_grad:
            return taps.sums(values)
        back = cached_tensors((*key, "back"), lambda: taps.transposed(self._count), **where)
        return _Product.apply(values, taps, back)

    def _owned(self, top: int, bottom: int) -> Taps:
        """Return taps in the owner of each pixel."""
        owner = on_device(self._canvas.owner[top:bottom].astype(np.int64).ravel(), self._device)
        flat = torch.arange(top * self._shape[1], bottom * self._shape[1], device=self._device)
        parts = [
            self._bilinear(image, self._offsets(image, pixels))
            for image, pixels in zip(
                owner.split(_PIXELS_AT_ONCE), flat.split(_PIXELS_AT_ONCE), strict=True
            )
        ]
        index, weight = (torch.cat(lines).flatten() for lines in zip(*parts, strict=True))
        first = torch.arange(0, len(index) + 1, 4, dtype=torch.int32, device=self._device)
        return Taps(index, weight, first)

    def _feathered(self, top: int, bottom: int) -> Taps:
        """Return taps in all images that cover each pixel."""
        height, width = bottom - top, self._shape[1]
        first_column, counts = self._canvas.spans[:, top:bottom].astype(np.int64).reshape(-1, 2).T
        ends = counts.cumsum()
        there = (on_device(part, self._device) for part in (first_column - (ends - counts), ends))
        shifts, ends_there = there
        parts = []
        for start in range(0, int(ends[-1]), _PIXELS_AT_ONCE):
            stop = min(start + _PIXELS_AT_ONCE, int(ends[-1]))
            place = torch.arange(start, stop, device=self._device)
            line = torch.searchsorted(ends_there, place, right=True)
            flat = (line % height) * width + (place + shifts[line]) % width
            offsets = self._offsets(line // height, flat + top * width)
            index, weight = self._bilinear(line // height, offsets)
            feather = (1 - offsets.square()).clamp_(min=0).prod(dim=0).sqrt_()[:, None]
            index = index.where(feather > 0, self._count - 1)
            parts.append((index, weight * feather.to(self._dtype), flat.int()))
        index, weight, flat = (torch.cat(lines) for lines in zip(*parts, strict=True))
        flat, order = flat.sort(stable=True)
        pixels = torch.arange(height * width + 1, dtype=torch.int32, device=self._device)
        first = 4 * torch.searchsorted(flat, pixels, out_int32=True)
        return Taps(index[order].flatten(), weight[order].flatten(), first)

    def _bilinear(self, image: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        """Return flat indices and weights ``(P, 4)`` of the pixels around P positions.

        Args:
            image: ``(P,)`` numbers of the images.
            offsets: See `_offsets`.
        """
        height, width = self._size
        sides = ((width, offsets[0]), (height, offsets[1]))
        u, v = ((((at + 1) * side - 1) / 2).clamp_(0, side - 1) for side, at in sides)
        column, row = (
            u.floor().clamp_(max=max(0, width - 2)),
            v.floor().clamp_(max=max(0, height - 2)),
        )
        right, below = (u - column).to(self._dtype), (v - row).to(self._dtype)
        first = ((image * height + row.int()) * width + column.int()).int()
        across, down = min(1, width - 1), min(1, height - 1) * width
        index = torch.stack([first + step for step in (0, across, down, down + across)], dim=-1)
        upper, lower = 1 - below, below
        weights = [upper * (1 - right), upper * right, lower * (1 - right), lower * right]
        return index, torch.stack(weights, dim=-1)

    @cached_property
    def _factors(self) -> tuple[Tensor, Tensor, Tensor]:
        """Homogeneous offsets in all images of all columns and rows; factors of the rows."""
        canvas, (height, width) = self._canvas, self._size
        scaled = np.diag([2 / width, 2 / height, 1]) @ canvas.matrices
        scaled[:, :2] += np.array([[1 / width - 1], [1 / height - 1]]) * canvas.matrices[:, 2:]
        matrices = scaled.transpose(1, 0, 2)
        of_columns = (matrices[..., :2] @ canvas.columns).reshape(3, -1)
        of_rows = (matrices[..., 2:] * canvas.rows[:, 1]).reshape(3, -1)
        dtype = np.float32 if self._device.type == "mps" else np.float64
        given = (of_columns, of_rows, canvas.rows[:, 0])
        columns, rows, factors = (
            on_device(part.astype(dtype, copy=False), self._device) for part in given
        )
        return columns, rows, factors

    def _offsets(self, image: Tensor, flat: Tensor) -> Tensor:
        """Return the positions of P pixels of the canvas in images.

        Args:
            image: ``(P,)`` indices of the images.
            flat: ``(P,)`` flat indices of the pixels.

        Returns:
            ``(2, P)`` offsets from the center of the image in half image sides, and 2 for
            directions behind the image.
        """
        (height, width), (of_columns, of_rows, factors) = self._shape, self._factors
        row, column = flat // width, flat % width
        across = of_columns.index_select(1, image * width + column)
        down = of_rows.index_select(1, image * height + row)
        xyz = torch.addcmul(down, factors.index_select(0, row), across)
        return (xyz[:2] / xyz[2]).masked_fill_(xyz[2] <= 0, 2)


def _as_slice(numbers: NDArray[np.int64]) -> slice | list[int]:
    """Return consecutive numbers as a slice, which is not a copy."""
    start, stop = int(numbers[0]), int(numbers[-1]) + 1
    return slice(start, stop) if stop - start == len(numbers) else numbers.tolist()


def _joined(parts: list[Tensor]) -> Tensor:
    """Concatenate tensors; one is not copied."""
    return torch.cat(parts) if len(parts) > 1 else parts[0]
