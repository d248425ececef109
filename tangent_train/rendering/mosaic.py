"""Class scores of one panorama or photo, accumulated image by image.

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


class ScoreMosaic:
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
        backend: Literal["numba", "torch"] | None = None,
        spare: NDArray[np.float32] | None = None,
    ) -> None:
        self.shape = shape
        self.blend: Blend = blend
        self._num_classes = num_classes
        self._min_confidence = min_confidence
        self._averaged = averaged or blend == "feather" or min_confidence > 0
        self._owned: tuple[object, Any] = None, NO_OWNERS
        self._on_device: DeviceSums | None = None
        self.sums = np.empty((0, 0, 0), np.float32)
        if backend is None:
            suits = torch.device(device).type != "cpu" and fits_on(device, shape, num_classes)
            backend = "torch" if suits else "numba"
        if backend == "torch":
            self._on_device = DeviceSums(shape, num_classes, device, averaged=self._averaged)
            return
        self._labels = np.zeros(shape, np.uint8 if num_classes < 256 else np.uint16)
        if self._averaged:
            self.sums = zero_sums(shape, num_classes, spare)

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
            add_to_canvas(array, images, *everywhere, owner, self.sums, softmax=True)
        else:
            label_canvas(array, images, owner, self._labels)

    def labels(self) -> Tensor:
        """Return ``(H, W)`` indices of the best classes (the first of equals); K where unsure."""
        if self._on_device is not None:
            return self._on_device.labels(self._min_confidence)
        if self._averaged:
            arguments = (self.sums, self._num_classes, self._min_confidence, self._labels)
            over_rows(kernels.best_classes, *self.shape, *arguments)
        return torch.from_numpy(self._labels)

    def probabilities(self, rows: slice | NDArray[np.intp]) -> Tensor:
        """Return ``(h, W, K)`` probabilities of some rows, which add up to 1; needs `averaged`."""
        if self._on_device is not None:
            index = rows if isinstance(rows, slice) else rows.tolist()
            total = self._on_device.sums[:, index].movedim(0, -1)
        else:
            total = torch.from_numpy(self.sums[rows][..., : self._num_classes])
        return total / total.sum(dim=-1, keepdim=True).clamp(min=_LEAST_TOTAL)

    def confidences(self) -> NDArray[np.float32]:
        """Return the ``(H, W)`` probabilities of the best classes; needs `averaged`."""
        step = max(1, _PIXELS_AT_ONCE // self.shape[1])
        starts = range(0, self.shape[0], step)
        parts = [self.probabilities(slice(top, top + step)).amax(dim=-1) for top in starts]
        return torch.cat(parts).cpu().numpy()

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
