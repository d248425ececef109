"""Add images to a canvas on the CPU, for labels, feathering and mosaics.

The blends `nearest` and `feather` are two weightings of the same sum. With `nearest` an image has
weight 1 where it is the owner; with `feather` its weight falls to 0 at its borders.
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
"""Given in place of owners, to feather."""

_IN_MEMORY_BYTES = 2**31
"""Sums of more bytes are kept in a temporary file."""

_SPANS = 2**23
"""Spans, one per row and image, that are held at once."""


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
        scores: ``(n, K, h, w)`` scores of the images.
        images: Place of the images on the canvas.
        shape: ``(H, W)`` of the canvas.
        rows: Rows of the canvas, without a step.
        owner: ``(rows, W)`` image that owns each pixel; or `NO_OWNERS`.
        total: Sums of these rows, from `zero_sums`, changed.
        softmax: True to add probabilities. With owners, scores are interpolated first; with
            feathering, probabilities are interpolated.
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
    """Write the best class of each pixel that some images own, or cover if they are feathered.

    Args:
        scores: ``(n, K, h, w)`` scores of the images; for feathering all images are needed.
        images: Place of the images on the canvas.
        owner: ``(H, W)`` image that owns each pixel; or `NO_OWNERS`.
        labels: ``(H, W)`` class indices, changed.
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
    """Yield bands of rows whose spans are held at once, and the same bands relative to `rows`."""
    step = max(64, _SPANS // max(1, images))
    for start in range(rows.start, rows.stop, step):
        stop = min(rows.stop, start + step)
        yield slice(start, stop), slice(start - rows.start, stop - rows.start)


def zero_sums(
    shape: tuple[int, int], channels: int, spare: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Return sums of channels set to 0; beyond 2 GiB they are kept in an unnamed temporary file.

    Args:
        shape: ``(H, W)``.
        channels: Number K of channels.
        spare: Sums that are no longer used; clearing them is faster than allocating memory.

    Returns:
        ``(H, W, Kp)`` sums, see `kernels`.

    Raises:
        SettingError: They do not fit on the disk (of the folder TMPDIR).
    """
    whole = (*shape, kernels.padded(channels))
    nbytes = math.prod(whole) * 4
    if nbytes <= _IN_MEMORY_BYTES:
        if spare is None or spare.shape != whole:
            return np.zeros(whole, np.float32)
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
        return np.memmap(file, np.float32, "r+", shape=whole)
