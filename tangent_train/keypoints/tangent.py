"""Keypoints found on tangent images."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from tangent_train.errors import SettingError
from tangent_train.geometry import TangentGrid
from tangent_train.keypoints.equirect import gray_panorama
from tangent_train.keypoints.spherical import SphericalKeypoints, local_to_sphere
from tangent_train.rendering import equirect_to_tangent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.keypoints.detectors import Detections, Detector

__all__ = ["detect_on_tangent_images"]

_PIXELS_AT_ONCE = 2**23
"""Pixels of images searched at once: SIFT needs about 300 bytes for each."""
_REPEAT_PIXELS = 1.0
_REPEAT_RATIO = 1.15
_REPEAT_COSINE = np.cos(np.deg2rad(20))
"""How far apart, of how different sizes and how differently turned one keypoint is found twice."""


def detect_on_tangent_images(
    image: NDArray[Any], grid: TangentGrid, detector: Detector, margin: int = 32
) -> SphericalKeypoints:
    """Find keypoints on the tangent images of a panorama.

    Every keypoint is kept by the image that owns its direction (`TangentGrid.owners`) and by no
    other: images overlap, and what is found twice would spoil the ratio test. Two images place a
    keypoint a little differently: one found on a border, by each in its own cell, is kept once; one
    found by each in the other's cell is lost, about one in 500 at base level 2.

    Args:
        image: ``(H, W)`` grey or ``(H, W, 3)`` RGB, uint8.
        grid: The tangent images. With a smaller `dim` than the default the search is faster; what
            lies beyond the owned cells and the margin only lends context to large keypoints.
        detector: The detector.
        margin: Pixels added on every side of the images, at the same pitch. Detectors find nothing
            near borders, and large keypoints need room, which images of higher base levels do not
            have: they have fewer pixels beyond what they own.

    Returns:
        Keypoints in the order of the faces they were found in.

    Raises:
        SettingError: The panorama or the margin cannot be used.
    """
    if margin < 0:
        raise SettingError("margin", found=margin, expected="0 pixels or more")
    gray = gray_panorama(image)
    wide = TangentGrid(grid.base_level, grid.level, grid.dim + 2 * margin, grid.rotation)

    def search(face: int) -> tuple[SphericalKeypoints, NDArray[np.int32]]:
        found = detector.detect(equirect_to_tangent(gray, wide, [face])[0])
        return _owned(wide, face, found)

    threads = min(torch.get_num_threads(), max(1, _PIXELS_AT_ONCE // wide.dim**2))
    with ThreadPoolExecutor(threads) as pool:
        parts, octaves = zip(*pool.map(search, range(wide.num_images)), strict=True)
    keypoints, levels = SphericalKeypoints.concatenated(parts), np.concatenate(octaves)
    single = np.flatnonzero(~_repeated(keypoints, wide.pitch))
    chosen = detector.strongest(keypoints.responses[single], levels[single])
    return keypoints.select(single[chosen])


def _owned(
    grid: TangentGrid, face: int, found: Detections
) -> tuple[SphericalKeypoints, NDArray[np.int32]]:
    """The keypoints that an image owns, on the sphere, and their octaves."""
    directions = _directions(grid, face, found.points_xy)
    own = grid.owners(directions) == face
    directions, found = directions[own], found.select(own)
    jacobian = gnomonic_jacobian(directions, grid, face)
    sizes, orientations = local_to_sphere(jacobian, found.sizes, found.angles_rad)
    images = np.full(len(directions), face, np.int32)
    keypoints = SphericalKeypoints(
        directions, sizes, orientations, found.responses, found.descriptors, images
    )
    return keypoints, found.octaves


def _repeated(keypoints: SphericalKeypoints, pitch: float) -> NDArray[np.bool_]:
    """The weaker of each two that are one keypoint, found on both sides of a border.

    Two images place a keypoint a little differently; if it is on their border, each may place it in
    its own cell.
    """
    near = cKDTree(keypoints.directions_xyz).query_pairs(
        _REPEAT_PIXELS * pitch, output_type="ndarray"
    )
    left, right = near.T
    sizes = keypoints.sizes_rad[near]
    turn = (keypoints.orientations_xyz[left] * keypoints.orientations_xyz[right]).sum(axis=1)
    same = keypoints.images[left] != keypoints.images[right]
    same &= sizes.max(axis=1) < _REPEAT_RATIO * sizes.min(axis=1)
    same &= turn > _REPEAT_COSINE
    weaker = np.where(keypoints.responses[left] < keypoints.responses[right], left, right)
    repeated = np.zeros(len(keypoints), np.bool_)
    repeated[weaker[same]] = True
    return repeated


def _directions(
    grid: TangentGrid, face: int, points_xy: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit vectors of pixel positions: ``A (X, Y, 1) / r`` with X, Y on the tangent plane."""
    plane = (points_xy - (grid.dim - 1) / 2) * grid.pitch
    rays = np.column_stack([plane, np.ones(len(plane))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return rays @ grid.world_from_camera[face].T


def gnomonic_jacobian(
    directions_xyz: NDArray[np.float64], grid: TangentGrid, face: int
) -> NDArray[np.float64]:
    """How directions move with their pixel in a tangent image: ``∂d/∂(column, row)``.

    At (X, Y) on the tangent plane, with r² = 1 + X² + Y², pitch p and the camera's axes
    A = (a, b, c): ``d = A (X, Y, 1) / r``, ``∂d/∂(column, row) = p/r · (I − d dᵀ) (a, b)``. Away
    from the centre the map shrinks by 1/r² along the radius and 1/r across it; the area factor is
    p²/r³.

    Args:
        directions_xyz: ``(n, 3)`` unit vectors in front of the image.
        grid: The images.
        face: The image.

    Returns:
        ``(n, 3, 2)``.
    """
    axes = grid.world_from_camera[face]
    seen = directions_xyz @ axes  # (n, 3): X/r, Y/r, 1/r
    across = axes[:, :2] - directions_xyz[:, :, None] * seen[:, None, :2]
    return grid.pitch * seen[:, 2, None, None] * across
