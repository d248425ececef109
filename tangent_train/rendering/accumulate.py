"""Adding images of a grid to a panorama, for labels, feathering and mosaics.

Nearest and feather are two weightings of the same sum: 1 where an image is the owner, or a weight
that falls to 0 at its borders.
"""

from __future__ import annotations

import math
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
from tangent_train.files import reserve
from tangent_train.geometry import PinholeGrid
from tangent_train.rendering import kernels
from tangent_train.rendering.compiled import over_rows
from tangent_train.rendering.tables import sight_of

__all__ = ["NO_LABELS", "NO_OWNERS", "NO_TOTAL", "add_to_panorama", "zero_sums"]

NO_OWNERS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)
"""Feather instead of taking each pixel from its owner."""

NO_TOTAL: NDArray[np.float32] = np.empty((0, 0, 0), np.float32)
"""Write labels instead of adding up."""

NO_LABELS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)
"""Add up instead of writing labels."""

_IN_MEMORY_BYTES = 2**31
"""Sums of more bytes are kept in a temporary file."""

_SPANS = 2**23
"""Rows times images whose spans are held at once."""


def add_to_panorama(
    scores: NDArray[np.float32],
    grid: PinholeGrid,
    faces: NDArray[np.int64],
    shape: tuple[int, int],
    rows: slice,
    owner: NDArray[np.integer] = NO_OWNERS,
    total: NDArray[np.float32] = NO_TOTAL,
    labels: NDArray[Any] = NO_LABELS,
    *,
    softmax: bool = False,
) -> None:
    """Add some images to rows of a panorama; the arrays are those of these rows.

    Args:
        scores: ``(n, K, d, d)`` of the images.
        grid: Their geometry.
        faces: ``(n,)`` which images they are.
        shape: ``(H, W)`` of the panorama.
        rows: Rows of it, without a step.
        owner: ``(rows, W)`` from `owners`; none to feather.
        total: ``(rows, W, K)`` weighted sums, changed; for the sum of the weights, add a channel
            of ones.
        labels: ``(rows, W)`` best classes, written where there is no `total`; feathered ones need
            all images at once.
        softmax: Whether scores become probabilities: those of owners after they are interpolated,
            feathered ones before.
    """
    step = max(64, _SPANS // max(1, len(faces)))
    for start in range(rows.start, rows.stop, step):
        band = slice(start, min(rows.stop, start + step))
        own = slice(band.start - rows.start, band.stop - rows.start)
        sight = sight_of(grid, faces, shape, band, owner[own])
        arguments = (np.ascontiguousarray(scores), sight, softmax, total[own], labels[own])
        over_rows(kernels.add_images, band.stop - band.start, shape[1], *arguments)


def zero_sums(shape: tuple[int, int], channels: int) -> NDArray[np.float32]:
    """``(H, W, K)`` sums, 0; beyond 2 GiB in a temporary file without a name.

    Args:
        shape: ``(H, W)``.
        channels: K.

    Raises:
        SettingError: They do not fit on the disk (of the folder TMPDIR).
    """
    whole = (*shape, channels)
    nbytes = math.prod(whole) * 4
    if nbytes <= _IN_MEMORY_BYTES:
        return np.zeros(whole, np.float32)
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
