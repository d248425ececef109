"""Detect keypoints on panoramas and on their tangent images."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tangent_train.geometry import (
    CubeGrid,
    PinholeGrid,
    TangentGrid,
    equirect_to_lonlat,
    lonlat_to_xyz,
)
from tangent_train.keypoints.spherical import SphericalKeypoints, equirect_jacobian, local_to_sphere
from tangent_train.rendering import equirect_to_tangent

_cv2: Any = cv2  # its types lack the detectors

_WRAP_SHARE = 8
"""A panorama is extended by W/8 columns on both sides. SIFT descriptors cover 5.3 times the size of
a keypoint, so keypoints up to W/42 are not affected by the seam."""

_PIXELS_AT_ONCE = 2**23
"""Number of pixels searched at once: SIFT needs about 300 bytes per pixel."""

_REPEAT_PIXELS = 1.0
_REPEAT_RATIO = 1.15
_REPEAT_COSINE = np.cos(np.deg2rad(20))
"""Two detections closer than this in position, size and orientation are one keypoint."""


class Detections(NamedTuple):
    """Keypoints of one image.

    Attributes:
        points_xy: ``(n, 2)`` float64 column and row; pixel centers are integers.
        sizes: ``(n,)`` float64 diameters in pixels.
        angles_rad: ``(n,)`` float64 from right towards down.
        responses: ``(n,)`` float32.
        descriptors: ``(n, 128)`` float32.
    """

    points_xy: NDArray[np.float64]
    sizes: NDArray[np.float64]
    angles_rad: NDArray[np.float64]
    responses: NDArray[np.float32]
    descriptors: NDArray[np.float32]


def detect(gray: NDArray[np.uint8]) -> Detections:
    """Detect and describe SIFT keypoints; safe to call from several threads.

    OpenCV's ``enable_precise_upscale`` is on: otherwise positions are off by ¼ pixel.

    Args:
        gray: ``(h, w)`` uint8.

    Returns:
        All keypoints in OpenCV's order. There are no keypoints within 1¾ pixels of the borders.
    """
    sift = _cv2.SIFT_create(enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(np.ascontiguousarray(gray), None)
    if not points:
        descriptors = np.empty((0, sift.descriptorSize()), np.float32)
    table = [(*p.pt, p.size, p.angle, p.response) for p in points]
    values = np.array(table, np.float64).reshape(-1, 5)
    responses = values[:, 4].astype(np.float32)
    return Detections(values[:, :2], values[:, 2], np.deg2rad(values[:, 3]), responses, descriptors)


def detect_on_equirect(image: NDArray[np.uint8]) -> SphericalKeypoints:
    """Detect keypoints on a panorama as on an ordinary image, but across the seam at ±180°.

    The image is extended by W/8 columns of its opposite side, left and right, so that keypoints at
    ±180° are detected once. As in the paper's baseline, it is not extended beyond the poles.

    Args:
        image: ``(H, W)`` gray or ``(H, W, 3)`` RGB, uint8.
    """
    gray = _gray(image)
    height, width = gray.shape
    pad = -(-width // _WRAP_SHARE)
    found = detect(np.pad(gray, ((0, 0), (pad, pad)), mode="wrap"))
    found.points_xy[:, 0] -= pad
    u = found.points_xy[:, 0]
    directions = lonlat_to_xyz(equirect_to_lonlat(found.points_xy, (height, width)))
    keypoints = _on_sphere(found, directions, equirect_jacobian(directions, (height, width)), 0)
    return keypoints.select((u >= -0.5) & (u < width - 0.5))


def detect_on_tangent_images(
    image: NDArray[np.uint8], grid: TangentGrid | CubeGrid, margin: int = 32
) -> SphericalKeypoints:
    """Detect keypoints on the tangent images of a panorama, or on the faces of a cube.

    Images overlap, and duplicates would break the ratio test. A keypoint is therefore kept only in
    the image that owns its direction, and once if two images detect it at their common border. It
    is lost if each image places it in the other's cell: about one in 500 at base level 2.

    Args:
        image: ``(H, W)`` gray or ``(H, W, 3)`` RGB, uint8.
        grid: Geometry of the images.
        margin: Pixels added on every side of the images, at the same pitch. Detectors find no
            keypoints near borders, and large keypoints need space.

    Returns:
        Keypoints in the order of the faces they were detected in.
    """
    gray = _gray(image)
    wide = grid.widened(margin)

    def search(face: int) -> SphericalKeypoints:
        found = detect(equirect_to_tangent(gray, wide, [face])[0])
        plane = (found.points_xy - wide.camera_matrix[:2, 2]) * wide.pitch
        rays = np.column_stack([plane, np.ones(len(plane))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        directions = rays @ wide.world_from_camera[face].T
        jacobian = gnomonic_jacobian(directions, wide, face)
        keypoints = _on_sphere(found, directions, jacobian, face)
        return keypoints.select(wide.owners(directions) == face)

    threads = min(torch.get_num_threads(), max(1, _PIXELS_AT_ONCE // math.prod(wide.size)))
    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(search, range(wide.num_images)))
    keypoints = SphericalKeypoints.concatenated(parts)
    return keypoints.select(~_repeated(keypoints, wide.pitch))


def gnomonic_jacobian(
    directions_xyz: NDArray[np.float64], grid: PinholeGrid, face: int
) -> NDArray[np.float64]:
    """Return the Jacobian of directions by pixel in a tangent image, ``∂d/∂(column, row)``.

    At (X, Y) on the tangent plane, with r² = 1 + X² + Y², pitch p and the camera's axes
    A = (a, b, c): ``d = A (X, Y, 1) / r``, ``∂d/∂(column, row) = p/r · (I − d dᵀ) (a, b)``.

    Args:
        directions_xyz: ``(n, 3)`` unit vectors in front of the image.
        grid: Geometry of the images.
        face: Index of the image.

    Returns:
        ``(n, 3, 2)``.
    """
    axes = grid.world_from_camera[face]
    seen = directions_xyz @ axes  # (n, 3): X/r, Y/r, 1/r
    across = axes[:, :2] - directions_xyz[:, :, None] * seen[:, None, :2]
    return grid.pitch * seen[:, 2, None, None] * across


def _gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _on_sphere(
    found: Detections, directions: NDArray[np.float64], jacobian: NDArray[np.float64], image: int
) -> SphericalKeypoints:
    sizes, orientations = local_to_sphere(jacobian, found.sizes, found.angles_rad)
    images = np.full(len(directions), image, np.int32)
    return SphericalKeypoints(
        directions, sizes, orientations, found.responses, found.descriptors, images
    )


def _repeated(keypoints: SphericalKeypoints, pitch: float) -> NDArray[np.bool_]:
    """Return a mask ``(n,)`` of keypoints that a neighboring image detected more strongly."""
    tree = cKDTree(keypoints.directions_xyz)
    near = tree.query_pairs(_REPEAT_PIXELS * pitch, output_type="ndarray")
    left, right = near.T
    sizes = keypoints.sizes_rad[near]
    cosine = (keypoints.orientations_xyz[left] * keypoints.orientations_xyz[right]).sum(axis=1)
    same = keypoints.images[left] != keypoints.images[right]
    same &= sizes.max(axis=1) < _REPEAT_RATIO * sizes.min(axis=1)
    same &= cosine > _REPEAT_COSINE
    weaker = np.where(keypoints.responses[left] < keypoints.responses[right], left, right)
    repeated = np.zeros(len(keypoints), np.bool_)
    repeated[weaker[same]] = True
    return repeated
