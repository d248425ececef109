"""Sparse keypoints on the sphere (paper, section "Sparse keypoint correspondences").

Keypoints are found on tangent images or on the panorama itself and live on the sphere from then on:
a direction, an angular size and an orientation, whatever image they were found in.
"""
