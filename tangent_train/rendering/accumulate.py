"""Adding images to a canvas on the CPU, for labels, feathering and mosaics.

Nearest and feather are two weightings of the same sum: 1 where an image is the owner, or a weight
that falls to 0 at its borders.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.files import reserve
from tangent_train.rendering import kernels
from tangent_train.rendering.compiled import over_rows

if TYPE_CHECKING:
    from tangent_train.rendering.representations.views import Views

_NO_TOTAL: NDArray[np.float32] = np.empty((0, 0, 0), np.float32)
_NO_LABELS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)

NO_OWNERS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)
"""Feather instead of taking each pixel from its owner."""

_IN_MEMORY_BYTES = 2**31
"""Sums of more bytes are kept in a temporary file."""

_SPANS = 2**23
"""Rows times images whose spans are held at once."""


def add_to_canvas(
    scores: NDArray[np.float32],
    images: Views,
    shape: tuple[int, int],
    rows: slice,
    owner: NDArray[np.integer],
    total: NDArray[np.float32],
    *,
    softmax: bool = False,
) -> None:
    """Add the weighted scores of some images to rows of a canvas.

    Args:
        scores: ``(n, K, h, w)`` of the images.
        images: Place of the images on the canvas.
        shape: ``(H, W)`` of the canvas.
        rows: Rows of it, without a step.
        owner: ``(rows, W)`` owners, weights are 1 there; or `NO_OWNERS`.
        total: Sums of these rows, from `zero_sums`, changed.
        softmax: True to add probabilities: those of owners are of the interpolated scores,
            feathered ones are interpolated.
    """
    for band, inner in _bands(rows, len(scores)):
        geometry = images.geometry(shape, band, owner[inner])
        arguments = (np.ascontiguousarray(scores), geometry, softmax, total[inner], _NO_LABELS)
        over_rows(kernels.add_images, band.stop - band.start, shape[1], *arguments)


def label_canvas(
    scores: NDArray[np.float32],
    images: Views,
    owner: NDArray[np.integer],
    labels: NDArray[Any],
) -> None:
    """Write the best classes of all pixels that some images own, or see where they are feathered.

    Args:
        scores: ``(n, K, h, w)`` of the images; of all images, for feathering.
        images: Place of the images on the canvas.
        owner: ``(H, W)`` owners; or `NO_OWNERS`.
        labels: ``(H, W)``, changed.
    """
    height, width = labels.shape
    scores = np.ascontiguousarray(scores)
    for band, _ in _bands(slice(0, height), len(scores)):
        geometry = images.geometry((height, width), band, owner[band])
        if len(owner):
            arguments: tuple[Any, ...] = scores, geometry, labels[band]
            over_rows(kernels.label_images, band.stop - band.start, width, *arguments)
        else:
            arguments = scores, geometry, False, _NO_TOTAL, labels[band]
            over_rows(kernels.add_images, band.stop - band.start, width, *arguments)


def _bands(rows: slice, images: int) -> Iterator[tuple[slice, slice]]:
    """Rows whose spans of all images are held at once, and where they are among these rows."""
    step = max(64, _SPANS // max(1, images))
    for start in range(rows.start, rows.stop, step):
        stop = min(rows.stop, start + step)
        yield slice(start, stop), slice(start - rows.start, stop - rows.start)


def zero_sums(
    shape: tuple[int, int], channels: int, spare: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Sums of channels, 0; beyond 2 GiB in a temporary file without a name.

    Args:
        shape: ``(H, W)``.
        channels: K.
        spare: Sums that are no longer used; clearing them is faster than new memory.

    Returns:
        ``(H, W, Kp)``, see `kernels`.

    Raises:
        SettingError: They do not fit on the disk (of the folder TMPDIR).
    """
    whole = (*shape, -(-channels // kernels.LANES) * kernels.LANES)
    nbytes = math.prod(whole) * 4
    if nbytes <= _IN_MEMORY_BYTES:
        if spare is None or spare.shape != whole:
            return np.zeros(whole, np.float32)
        spare[:] = 0
        return spare
    # The file has no name: it is gone with the array, whatever happens.
    with tempfile.TemporaryFile() as file:
        try:  # now: of a full disk the system says nothing later, it ends the process
            reserve(file, nbytes)
        except OSError as error:
            raise SettingError(
                f"temporary folder {tempfile.gettempdir()}",
                found=error,
                expected=f"room for {nbytes / 1e9:.1f} GB of scores",
                remedy="Set TMPDIR to a folder on a larger disk, or use blend=nearest for labels.",
            ) from error
        return np.memmap(file, np.float32, "r+", shape=whole)
