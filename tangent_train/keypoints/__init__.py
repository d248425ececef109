"""Sparse keypoints on the sphere (paper, section "Sparse keypoint correspondences").

Keypoints are detected on tangent images or on the panorama itself. They are stored on the sphere,
independently of the image: a direction, an angular size and an orientation.
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
