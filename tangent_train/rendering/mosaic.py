"""Images combined on a canvas: class scores, depth or colors of one panorama or photo.

A mosaic takes a few views at a time, from one or more sets, and does not keep them. There are two
backends with the same results: compiled kernels on the CPU (`numba_sums`), and torch on any device
(`torch_sums`), which can be differentiated.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

from tangent_train.rendering.checks import Blend, blend_of
from tangent_train.rendering.numba_sums import NO_SUMS, NumbaSums
from tangent_train.rendering.torch_sums import TorchSums, fits_on

if TYPE_CHECKING:
    import numpy as np
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
        self.shape = shape
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
        values = values if values.dtype == torch.float64 else values.float()
        images, views = views.on_canvas(values, self.shape)
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
        device: See `Mosaic`.
        backend: See `Mosaic`.
        spare: See `Mosaic`.

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
        device: torch.device | str = "cpu",
        backend: Backend = None,
        spare: NDArray[np.float32] | None = None,
    ) -> None:
        averaged = averaged or blend == "feather" or min_confidence > 0
        super().__init__(
            shape,
            num_classes,
            blend,
            averaged=averaged,
            softmax=True,
            device=device,
            backend=backend,
            spare=spare,
        )
        self._min_confidence = min_confidence

    def labels(self) -> Tensor:
        """Return ``(H, W)`` indices of the best classes (the first of equals); K where unsure."""
        return self._backend.labels(self._min_confidence)

    def probabilities(self, rows: slice | NDArray[np.intp]) -> Tensor:
        """Return ``(h, W, K)`` probabilities of some rows, which add up to 1; needs `averaged`."""
        total = self._backend.rows(rows)
        return total / total.sum(dim=-1, keepdim=True).clamp(min=_LEAST_TOTAL)

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
        device: See `Mosaic`.
        backend: See `Mosaic`.
        dtype: See `Mosaic`.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        blend: Blend,
        channels: int = 1,
        *,
        skips_unknown: bool = True,
        device: torch.device | str = "cpu",
        backend: Backend = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(shape, channels + 1, blend, device=device, backend=backend, dtype=dtype)
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
