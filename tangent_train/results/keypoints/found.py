"""Keypoints of two panoramas, their matches, and the geometry that explains them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tangent_train.keypoints.spherical import SphericalKeypoints
    from tangent_train.keypoints.two_view import TwoView

__all__ = ["Found"]


class Found(NamedTuple):
    """What was found on two panoramas.

    Attributes:
        left: Keypoints of the left panorama.
        right: Keypoints of the right one.
        matches: ``(m, 2)`` indices into both.
        geometry: What explains them.
    """

    left: SphericalKeypoints
    right: SphericalKeypoints
    matches: NDArray[np.int64]
    geometry: TwoView
