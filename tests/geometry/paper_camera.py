"""The camera normalization of the paper's supplement, section 2.1, as a reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tangent_train.geometry import camera_matrix_from_fov


def normalizing_homography(
    camera_matrix: NDArray[np.float64], fov_deg: float, crop: tuple[int, int], shift: ArrayLike
) -> NDArray[np.float64]:
    """K'(K+Δ)⁻¹, from old to new pixels, of a crop of ``(height, width)`` and a shift (δx, δy)."""
    moved = camera_matrix.copy()
    moved[:2, 2] += np.asarray(shift, np.float64)
    return np.asarray(camera_matrix_from_fov(fov_deg, crop) @ np.linalg.inv(moved))
