"""Sparse keypoints on the sphere (paper, section "Sparse keypoint correspondences").

Keypoints are detected on tangent images or on the panorama itself. From then on they live on the
sphere: a direction, an angular size and an orientation, whatever image they were detected in.
"""

from tangent_train.keypoints.detect import detect_on_equirect, detect_on_tangent_images
from tangent_train.keypoints.matching import match
from tangent_train.keypoints.spherical import SphericalKeypoints
from tangent_train.keypoints.two_view import TwoView, estimate_two_view

__all__ = [
    "SphericalKeypoints",
    "TwoView",
    "detect_on_equirect",
    "detect_on_tangent_images",
    "estimate_two_view",
    "match",
]
