"""Small images as a lens with radial distortion shows them, and a zoom to compare with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from studies.digits import BODY, SIDE
from tangent_train.geometry.brown_conrady import undistort

__all__ = ["frame_points", "lens_images", "mean_enlargement", "zoom_images"]


def frame_points(side: int) -> NDArray[np.float64]:
    """``(side, side, 2)`` right and down of pixel centres; the image's edges are at −1 and 1."""
    line = (np.arange(side) + 0.5) / side * 2 - 1
    return np.stack(np.meshgrid(line, line), axis=-1)


def lens_images(images: NDArray[np.float32], k1: float) -> NDArray[np.float32]:
    """Images with pincushion distortion about their middle, bilinear; dark beyond their edges.

    Args:
        images: ``(n, side, side)``.
        k1: K1 ≥ 0 of Brown and Conrady's model, where half a side is the unit of length.
    """
    return _sample(images, undistort(frame_points(images.shape[1]), k1))


def zoom_images(images: NDArray[np.float32], k1: float) -> NDArray[np.float32]:
    """Images enlarged evenly, by `mean_enlargement`; bilinear.

    Args:
        images: ``(n, side, side)``.
        k1: K1 ≥ 0 of the distortion to compare with.
    """
    return _sample(images, frame_points(images.shape[1]) / mean_enlargement(k1))


def mean_enlargement(k1: float) -> float:
    """Mean of 1 + K1 r² over the square in the middle that digits fill: 1 + K1 · ⅔ (20/28)²."""
    return 1 + k1 * 2 / 3 * (BODY / SIDE) ** 2


def _sample(images: NDArray[np.float32], points: NDArray[np.float64]) -> NDArray[np.float32]:
    side = images.shape[1]
    position = (points + 1) / 2 * side - 0.5
    # A dark rim of one pixel is what lies beyond the edges.
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1)))
    position = np.clip(position + 1, 0, side + 1)
    first = np.minimum(position.astype(np.intp), side)
    (u, v), (s, t) = np.moveaxis(first, -1, 0), np.moveaxis(position - first, -1, 0)
    total = np.zeros(images.shape, np.float32)
    for row, column, weight in (
        (v, u, (1 - s) * (1 - t)),
        (v, u + 1, s * (1 - t)),
        (v + 1, u, (1 - s) * t),
        (v + 1, u + 1, s * t),
    ):
        total += padded[:, row, column] * weight.astype(np.float32)
    return total
