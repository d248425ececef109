"""Adding images of a grid to a panorama, for labels, feathering and mosaics.

Nearest and feather are two weightings of the same sum: 1 where an image is the owner, or a weight
that falls to 0 at its borders.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import PinholeGrid
from tangent_train.rendering import kernels
from tangent_train.rendering.compiled import over_rows
from tangent_train.rendering.tables import sight_of

__all__ = ["NO_LABELS", "NO_OWNERS", "NO_TOTAL", "add_to_panorama"]

NO_OWNERS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)
"""Feather instead of taking each pixel from its owner."""

NO_TOTAL: NDArray[np.float32] = np.empty((0, 0, 0), np.float32)
"""Write labels instead of adding up."""

NO_LABELS: NDArray[np.uint8] = np.empty((0, 0), np.uint8)
"""Add up instead of writing labels."""

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
        total: ``(rows, W, K + 1)`` weighted sums, and the sum of the weights, changed.
        labels: ``(rows, W)`` best classes, written where there is no `total`; feathered ones need
            all images at once.
        softmax: Whether scores become probabilities after they are interpolated.
    """
    step = max(64, _SPANS // max(1, len(faces)))
    for start in range(rows.start, rows.stop, step):
        band = slice(start, min(rows.stop, start + step))
        own = slice(band.start - rows.start, band.stop - rows.start)
        sight = sight_of(grid, faces, shape, band, owner[own])
        arguments = (np.ascontiguousarray(scores), sight, softmax, total[own], labels[own])
        over_rows(kernels.add_images, band.stop - band.start, shape[1], *arguments)
