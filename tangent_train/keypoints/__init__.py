"""Sparse keypoints on the sphere (paper, section "Sparse keypoint correspondences")."""

from tangent_train.keypoints.features import (
    SphericalKeypoints,
    detect_on_equirect,
    detect_on_tangent_images,
    match,
)
from tangent_train.keypoints.two_view import TwoView, estimate_two_view

__all__ = [
    "SphericalKeypoints",
    "TwoView",
    "detect_on_equirect",
    "detect_on_tangent_images",
    "estimate_two_view",
    "match",
]
