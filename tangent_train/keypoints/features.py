"""Detect keypoints on panoramas and on their tangent images, and match them.

Keypoints are stored on the sphere: a direction, an angular size and an orientation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from tangent_train.geometry import (
    CubeGrid,
    TangentGrid,
    equirect_to_lonlat,
    lonlat_to_equirect,
    lonlat_to_xyz,
    xyz_to_lonlat,
)
from tangent_train.geometry.sphere import Floats
from tangent_train.rendering import equirect_to_tangent
from tangent_train.rendering.kernels import num_threads
from tangent_train.rendering.resampling import reduce_to_pitch

_cv2: Any = cv2  # its types lack the detectors

_WRAP_SHARE = 8
"""A panorama is extended by W/8 columns on both sides. SIFT descriptors cover 5.3 times the size of
a keypoint, so keypoints up to W/42 are not affected by the seam."""

_PIXELS_AT_ONCE = 2**23
"""Number of pixels searched at once: SIFT needs about 300 bytes per pixel."""

_STEP = 1e-4  # pixels of the differences that give the derivative of directions
_REPEAT_PIXELS = 1.0
_REPEAT_RATIO = 1.15
_REPEAT_COSINE = np.cos(np.deg2rad(20))
"""Two detections closer than this in position, size and orientation are one keypoint."""


@dataclass(frozen=True, eq=False)
class SphericalKeypoints:
    """n keypoints in the frame of `tangent_train.geometry`.

    Sizes and orientations come from OpenCV, mapped from image to sphere (`local_to_sphere`).

    Attributes:
        directions_xyz: ``(n, 3)`` float64 unit vectors.
        sizes_rad: ``(n,)`` float32, angular diameter of the neighborhood (``KeyPoint.size``).
        orientations_xyz: ``(n, 3)`` float64 unit vectors, perpendicular to the directions.
        responses: ``(n,)`` float32 strength.
        descriptors: ``(n, D)`` float32.
        images: ``(n,)`` int32, the face in which each was detected; 0 for a panorama.
    """

    directions_xyz: Floats
    sizes_rad: NDArray[np.float32]
    orientations_xyz: Floats
    responses: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    images: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.directions_xyz)

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.integer]) -> Self:
        """Return some of the keypoints, by a mask or by indices."""
        return type(self)(*(getattr(self, field.name)[chosen] for field in fields(self)))

    def equirect_pixels(self, shape: tuple[int, int]) -> Floats:
        """Return ``(n, 2)`` columns and rows in a panorama ``(H, W)``; centers are integers."""
        return lonlat_to_equirect(xyz_to_lonlat(self.directions_xyz), shape)


def angles_between(first_xyz: ArrayLike, second_xyz: ArrayLike) -> Floats:
    """Return ``(...)`` angles of ``(..., 3)`` unit vectors in radians, precise near 0 and π."""
    first, second = np.asarray(first_xyz, np.float64), np.asarray(second_xyz, np.float64)
    halves = (np.linalg.norm(first + sign * second, axis=-1) for sign in (-1, 1))
    return np.asarray(2 * np.arctan2(*halves))


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

    def directions(pixels_xy: Floats) -> Floats:
        return lonlat_to_xyz(equirect_to_lonlat(pixels_xy - np.array([pad, 0]), (height, width)))

    wide = np.pad(gray, ((0, 0), (pad, pad)), mode="wrap")
    columns, keypoints = _detect(wide, directions)
    return keypoints.select((columns >= pad - 0.5) & (columns < pad + width - 0.5))


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
    gray = reduce_to_pitch(_gray(image), grid.pitch)
    wide = grid.widened(margin)

    def search(face: int) -> SphericalKeypoints:
        def directions(pixels_xy: Floats) -> Floats:
            plane = (pixels_xy - wide.camera_matrix[:2, 2]) * wide.pitch
            rays = np.column_stack([plane, np.ones(len(plane))])
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            return np.asarray(rays @ wide.world_from_camera[face].T)

        _, keypoints = _detect(equirect_to_tangent(gray, wide, [face])[0], directions, face)
        return keypoints.select(wide.owners(keypoints.directions_xyz) == face)

    threads = min(num_threads(), max(1, _PIXELS_AT_ONCE // math.prod(wide.size)))
    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(search, range(wide.num_images)))
    columns = ([getattr(part, field.name) for part in parts] for field in fields(parts[0]))
    keypoints = SphericalKeypoints(*map(np.concatenate, columns))
    return keypoints.select(~_repeated(keypoints, wide.pitch))


def _gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _detect(
    gray: NDArray[np.uint8], directions: Callable[[Floats], Floats], image: int = 0
) -> tuple[Floats, SphericalKeypoints]:
    """Detect SIFT keypoints; safe to call from several threads.

    OpenCV's ``enable_precise_upscale`` is on: otherwise positions are off by ¼ pixel. There are no
    keypoints within 1¾ pixels of the borders.

    Args:
        gray: ``(h, w)`` image.
        directions: Returns the ``(n, 3)`` unit vectors of ``(n, 2)`` columns and rows.
        image: Index of the image.

    Returns:
        ``(n,)`` columns, and keypoints in OpenCV's order.
    """
    sift = _cv2.SIFT_create(enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(np.ascontiguousarray(gray), None)
    if not points:
        descriptors = np.empty((0, sift.descriptorSize()), np.float32)
    table = [(*p.pt, p.size, p.angle, p.response) for p in points]
    x, y, diameters, angles_deg, responses = np.array(table, np.float64).reshape(-1, 5).T
    pixels, steps = np.stack([x, y], axis=-1), _STEP * np.eye(2)
    changes = [directions(pixels + step) - directions(pixels - step) for step in steps]
    jacobian = np.stack(changes, axis=-1) / (2 * _STEP)
    sizes, orientations = local_to_sphere(jacobian, diameters, np.deg2rad(angles_deg))
    strengths, images = responses.astype(np.float32), np.full(len(x), image, np.int32)
    rays = directions(pixels)
    return x, SphericalKeypoints(rays, sizes, orientations, strengths, descriptors, images)


def local_to_sphere(
    jacobian: Floats, sizes: NDArray[np.floating], angles_rad: NDArray[np.floating]
) -> tuple[NDArray[np.float32], Floats]:
    """Map sizes and orientations of keypoints from an image to the sphere.

    A disc in the image becomes an ellipse on the sphere. Its size is the diameter of a disc of the
    same area: ``size · √|∂d/∂u × ∂d/∂v|``. The orientation of a keypoint is the mean gradient of
    the gray values around it. A gradient is a covector: with the Jacobian J (3×2) it becomes
    ``J (JᵀJ)⁻¹ (cos a, sin a)``, scaled to length 1.

    Args:
        jacobian: ``(n, 3, 2)`` ``∂d/∂(u, v)``, tangent to the sphere, columns not parallel.
        sizes: ``(n,)`` diameters in pixels.
        angles_rad: ``(n,)`` orientations from right (u) towards down (v).

    Returns:
        ``(n,)`` sizes in radians and ``(n, 3)`` unit tangent vectors.
    """
    area = np.linalg.norm(np.cross(jacobian[..., 0], jacobian[..., 1]), axis=-1)
    gradient = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
    vectors = np.einsum("nic,ni->nc", np.linalg.pinv(jacobian), gradient)
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (sizes * np.sqrt(area)).astype(np.float32), vectors


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
    return np.isin(np.arange(len(keypoints)), weaker[same])


def match(
    left_descriptors: NDArray[np.float32],
    right_descriptors: NDArray[np.float32],
    ratio: float = 0.8,
    *,
    mutual: bool = True,
) -> NDArray[np.int64]:
    """Match each left descriptor with its nearest right descriptor, if that is unambiguous.

    Time grows with n_l · n_r, memory with n_r. Distances have no rounding errors for integers up to
    255, such as SIFT's. The first of several equally near descriptors is taken.

    Args:
        left_descriptors: ``(n_l, D)`` descriptors.
        right_descriptors: ``(n_r, D)`` descriptors.
        ratio: Keep a match if its Euclidean distance is less than this share of the distance to the
            second nearest (Lowe 2004; the paper uses 0.8). 1 or more keeps all.
        mutual: True to keep a match only if each descriptor is the nearest to the other.

    Returns:
        ``(m, 2)`` indices of left and right descriptors, sorted by the left ones.
    """
    left, right = left_descriptors, right_descriptors
    if not (len(left) and len(right)):
        return np.empty((0, 2), np.int64)
    squares, nearest = _cv2.batchDistance(
        left, right, cv2.CV_32F, normType=cv2.NORM_L2SQR, K=min(2, len(right))
    )
    chosen = np.arange(len(left))
    if ratio < 1 < len(right):
        chosen = np.flatnonzero(squares[:, 0] < ratio**2 * squares[:, 1])
    pairs = np.stack([chosen, nearest[chosen, 0]], axis=1).astype(np.int64)
    if mutual and len(chosen):
        _, back = _cv2.batchDistance(
            right[pairs[:, 1]], left, cv2.CV_32F, normType=cv2.NORM_L2SQR, K=1
        )
        pairs = pairs[back[:, 0] == chosen]
    return pairs
