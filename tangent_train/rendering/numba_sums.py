"""Sums or labels of a canvas, accumulated by compiled kernels on the CPU.

The blends `nearest` and `feather` are two weightings of the same sum. With `nearest` an image has
weight 1 where it is the owner; with `feather` its weight falls to 0 at its borders.
"""

from __future__ import annotations

import math
import tempfile
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.files import reserve
from tangent_train.rendering import kernels
from tangent_train.rendering.kernels import over_rows

if TYPE_CHECKING:
    from torch import Tensor

    from tangent_train.rendering.representations.views import Views

NO_SUMS: NDArray[np.float32] = np.empty((0, 0, 0), np.float32)
_NO_LABELS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)

_IN_MEMORY_BYTES = 2**31
"""Sums of more bytes are kept in a temporary file."""


class NumbaSums:
    """Sums of a canvas, or the labels of the largest channels; see `Mosaic` for the arguments.

    Attributes:
        sums: ``(H, W, Kp)`` float32, see `kernels`; empty if they are not kept.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int,
        spare: NDArray[np.float32] | None = None,
        *,
        averaged: bool,
        softmax: bool,
    ) -> None:
        self._shape, self._channels, self._softmax = shape, channels, softmax
        self._labels: NDArray[Any] = np.zeros(shape, np.uint8 if channels < 256 else np.uint16)
        self._owned: tuple[object, NDArray[np.integer]] = None, kernels.NO_OWNERS
        self.sums = _zeros((*shape, kernels.padded(channels)), spare) if averaged else NO_SUMS

    def add(self, values: Tensor, images: Views, *, is_feathered: bool) -> None:
        """Add some images.

        Args:
            values: ``(n, K, h, w)`` values of the images.
            images: Position of the images on the canvas.
            is_feathered: True to feather them. If only labels are kept, all images are needed at
                once. False to take each pixel from its owner. The softmax is computed before the
                interpolation of feathered images, and after that of owners.
        """
        owner = None if is_feathered else self._owners(images)
        geometry = images.geometry(self._shape, owner)
        array = values.detach().float().contiguous().cpu().numpy()
        if not len(array):
            return
        written = (self._softmax, self.sums, _NO_LABELS)
        if not len(self.sums):
            written = (False, NO_SUMS, self._labels)
        over_rows(kernels.add_images, *self._shape, array, geometry, *written)

    def _owners(self, images: Views) -> NDArray[np.integer]:
        """Return the owner of each pixel, cached until images of another set are added."""
        if self._owned[0] != images.key:
            self._owned = images.key, images.owners(self._shape)
        return self._owned[1]

    def unknown(self) -> Tensor:
        """Return the number of pixels at which a view has a score that is NaN or infinite."""
        if len(self.sums):
            return torch.tensor(np.isnan(self.sums[..., 0]).sum())
        return torch.tensor((self._labels == self._channels).sum())

    def rows(self, rows: slice | NDArray[np.intp]) -> Tensor:
        """Return the sums ``(h, W, K)`` of some rows."""
        return torch.from_numpy(self.sums[rows][..., : self._channels])

    def labels(self, min_confidence: float) -> Tensor:
        """Return ``(H, W)`` indices of the best classes; K where the confidence is too low."""
        if len(self.sums):
            arguments = self.sums, self._channels, min_confidence, self._labels
            over_rows(kernels.best_classes, *self._shape, *arguments)
        return torch.from_numpy(self._labels)


def _zeros(shape: tuple[int, int, int], spare: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """Return zeros; beyond 2 GiB in an unnamed temporary file.

    Args:
        shape: ``(H, W, Kp)``.
        spare: Sums that are no longer used; clearing them is faster than allocating memory.

    Raises:
        SettingError: They do not fit on the disk (of the folder TMPDIR).
    """
    nbytes = math.prod(shape) * 4
    if nbytes <= _IN_MEMORY_BYTES:
        if spare is None or spare.shape != shape:
            return np.zeros(shape, np.float32)
        spare[:] = 0
        return spare
    # The file has no name: the system deletes it with the array, even if the process is killed.
    with tempfile.TemporaryFile() as file:
        try:  # now: writing to a memory map on a full disk later would kill the process
            reserve(file, nbytes)
        except OSError as error:
            raise SettingError(
                f"temporary folder {tempfile.gettempdir()}",
                found=error,
                expected=f"room for {nbytes / 1e9:.1f} GB of scores",
                remedy="Set TMPDIR to a folder on a larger disk, or use blend=nearest for labels.",
            ) from error
        return np.memmap(file, np.float32, "r+", shape=shape)
