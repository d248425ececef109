"""Class scores or depth of one panorama or photo, accumulated image by image.

`tangent_to_labels` takes the scores of all images at once: 5 GB for 13 classes at level 11. A
mosaic takes a few images at a time, from one or more grids, and does not keep their scores. Unless
probabilities are averaged, it keeps only labels.

There are two backends with the same results: compiled kernels on the CPU (`accumulate`), and torch
on any device (`device_mosaic`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch

from tangent_train.rendering import kernels
from tangent_train.rendering.accumulate import NO_OWNERS, add_to_canvas, label_canvas, zero_sums
from tangent_train.rendering.checks import Blend, blend_of
from tangent_train.rendering.compiled import over_rows
from tangent_train.rendering.device_mosaic import DeviceSums, fits_on

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from torch import Tensor

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
        blend: Blend of the images.
        averaged: True to keep sums; False to keep only labels.
        softmax: True to add the softmax of the channels.
        device: Device of the mosaic; sums that are too large for it are kept on the CPU.
        backend: ``numba`` on the CPU, or ``torch``; None to choose by device.
        spare: `sums` of a mosaic that is no longer used, to reuse its memory.

    Raises:
        SettingError: The temporary file for the sums does not fit on the disk.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int,
        blend: Blend,
        *,
        averaged: bool,
        softmax: bool,
        device: torch.device | str = "cpu",
        backend: Backend = None,
        spare: NDArray[np.float32] | None = None,
    ) -> None:
        self.shape = shape
        self.blend: Blend = blend
        self._channels, self._averaged, self._softmax = channels, averaged, softmax
        self._owned: tuple[object, Any] = None, NO_OWNERS
        self._on_device: DeviceSums | None = None
        self.sums = np.empty((0, 0, 0), np.float32)
        if backend is None:
            suits = torch.device(device).type != "cpu" and fits_on(device, shape, channels)
            backend = "torch" if suits else "numba"
        if backend == "torch":
            how = {"averaged": averaged, "softmax": softmax}
            self._on_device = DeviceSums(shape, channels, device, **how)
            return
        self._labels = np.zeros(shape, np.uint8 if channels < 256 else np.uint16)
        if averaged:
            self.sums = zero_sums(shape, channels, spare)

    def add(self, scores: Tensor, views: Views) -> None:
        """Add some views of a set; each view of the set must be added once.

        Args:
            scores: ``(n, K, h, w)`` scores, not probabilities.
            views: The views.
        """
        scores, images = views.placed(scores.detach().float(), self.shape)
        owner = self._owners(images)
        if self._on_device is not None:
            self._on_device.add(scores, images, owner if len(owner) else None)
            return
        array = scores.contiguous().cpu().numpy()
        if self._averaged:
            everywhere = self.shape, slice(0, self.shape[0])
            add_to_canvas(array, images, *everywhere, owner, self.sums, softmax=self._softmax)
        else:
            label_canvas(array, images, owner, self._labels)

    def _rows(self, rows: slice | NDArray[np.intp]) -> Tensor:
        """Return the sums ``(h, W, K)`` of some rows."""
        if self._on_device is not None:
            index = rows if isinstance(rows, slice) else rows.tolist()
            return self._on_device.sums[:, index].movedim(0, -1)
        return torch.from_numpy(self.sums[rows][..., : self._channels])

    def _owners(self, images: Views) -> Any:
        """Return the owner of each pixel, cached until images of another set are added."""
        if blend_of(self.blend, is_overlapping=images.is_overlapping) == "feather":
            return NO_OWNERS
        if self._owned[0] is not images.all_images:
            owner: Any = images.owners(self.shape)
            if self._on_device is not None:
                owner = torch.from_numpy(owner).to(self._on_device.sums.device)
            self._owned = images.all_images, owner
        return self._owned[1]


class ScoreMosaic(Mosaic):
    """Scores of K classes at every pixel of a panorama or photo.

    Args:
        shape: ``(H, W)`` of the panorama or photo.
        num_classes: K.
        blend: ``nearest``: a pixel takes the scores of the image that owns it, as in
            `tangent_to_labels`. ``feather``: the weighted average of the probabilities of all
            images that cover it; see `blend_of`.
        averaged: True to keep sums of probabilities. ``feather`` always keeps them; ``nearest``
            needs them for several sets of images and for `probabilities`. They take 4 K bytes per
            pixel; on the CPU K is rounded up to a multiple of 16, and sums beyond 2 GiB are kept in
            a temporary file (in the folder TMPDIR).
        min_confidence: Confidence below which a pixel has no class, see `labels`; above 0, sums are
            kept.
        device: Device of the mosaic; sums that are too large for it are kept on the CPU.
        backend: ``numba`` on the CPU, or ``torch``; None to choose by device.
        spare: `sums` of a mosaic that is no longer used, to reuse its memory.

    Attributes:
        shape: ``(H, W)`` of the panorama or photo.
        blend: Blend of the images.
        sums: Sums of probabilities on the CPU, from `zero_sums`; empty if they are not kept.

    Raises:
        SettingError: The temporary file for the sums does not fit on the disk.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        num_classes: int,
        blend: Blend,
        *,
        averaged: bool = False,
        min_confidence: float = 0.0,
        device: torch.device | str = "cpu",
        backend: Backend = None,
        spare: NDArray[np.float32] | None = None,
    ) -> None:
        averaged = averaged or blend == "feather" or min_confidence > 0
        how: dict[str, Any] = {"device": device, "backend": backend, "spare": spare}
        super().__init__(shape, num_classes, blend, averaged=averaged, softmax=True, **how)
        self._min_confidence = min_confidence

    def labels(self) -> Tensor:
        """Return ``(H, W)`` indices of the best classes (the first of equals); K where unsure."""
        if self._on_device is not None:
            return self._on_device.labels(self._min_confidence)
        if self._averaged:
            arguments = (self.sums, self._channels, self._min_confidence, self._labels)
            over_rows(kernels.best_classes, *self.shape, *arguments)
        return torch.from_numpy(self._labels)

    def probabilities(self, rows: slice | NDArray[np.intp]) -> Tensor:
        """Return ``(h, W, K)`` probabilities of some rows, which add up to 1; needs `averaged`."""
        total = self._rows(rows)
        return total / total.sum(dim=-1, keepdim=True).clamp(min=_LEAST_TOTAL)

    def confidences(self) -> NDArray[np.float32]:
        """Return the ``(H, W)`` probabilities of the best classes; needs `averaged`."""
        step = max(1, _PIXELS_AT_ONCE // self.shape[1])
        starts = range(0, self.shape[0], step)
        parts = [self.probabilities(slice(top, top + step)).amax(dim=-1) for top in starts]
        return torch.cat(parts).cpu().numpy()


class DepthMosaic(Mosaic):
    """Means of the depth of images, weighted as scores are; unknown pixels of images do not count.

    The second of two channels sums the weights, so that the memory is that of two numbers per
    pixel.

    Args:
        shape: ``(H, W)`` of the panorama or photo.
        blend: See `ScoreMosaic`.
        device: See `ScoreMosaic`.
        backend: See `ScoreMosaic`.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        blend: Blend,
        *,
        device: torch.device | str = "cpu",
        backend: Backend = None,
    ) -> None:
        how: dict[str, Any] = {"device": device, "backend": backend}
        super().__init__(shape, 2, blend, averaged=True, softmax=False, **how)

    def add(self, scores: Tensor, views: Views) -> None:
        """Add some views of a set.

        Args:
            scores: ``(n, 1, h, w)`` values, NaN where unknown.
            views: The views.
        """
        is_known = scores.isfinite()
        super().add(torch.cat([scores.where(is_known, 0), is_known.to(scores)], dim=1), views)

    def values(self) -> Tensor:
        """Return the ``(H, W)`` means; NaN where no image has a value."""
        total, weight = self._rows(slice(None)).unbind(dim=-1)
        return (total / weight).where(weight >= _LEAST_VALID[self.blend], torch.nan)
