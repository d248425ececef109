"""Detecting keypoints on panoramas and on their tangent images."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_to_lonlat, lonlat_to_xyz
from tangent_train.keypoints.spherical import (
    SphericalKeypoints,
    equirect_jacobian,
    local_to_sphere,
)
from tangent_train.rendering import equirect_to_tangent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from tangent_train.geometry import CubeGrid, PinholeGrid, TangentGrid


_cv2: Any = cv2  # its types lack the detectors

_SMALLEST_SIDE = 16
"""Pixels; ORB's pyramid fails on smaller images."""

_ORB_SCALE = 1.2
_ORB_KEYPOINTS = 10_000
"""Most keypoints of a panorama with ORB, which finds far too many corners otherwise."""

_WRAP_SHARE = 8
"""A panorama is continued by W/8 columns: SIFT's descriptors reach 5.3 times a keypoint's size, so
those up to W/42 are computed as if there were no seam."""

_PIXELS_AT_ONCE = 2**23
"""Pixels of images searched at once: SIFT needs about 300 bytes for each."""

_REPEAT_PIXELS = 1.0
_REPEAT_RATIO = 1.15
_REPEAT_COSINE = np.cos(np.deg2rad(20))
"""Two detections closer than this in position, size and orientation are one keypoint."""


class Detections(NamedTuple):
    """Keypoints of one image.

    Attributes:
        points_xy: ``(n, 2)`` float64 column and row; pixel centres are integers.
        sizes: ``(n,)`` float64 diameters in pixels.
        angles_rad: ``(n,)`` float64 from right towards down.
        responses: ``(n,)`` float32.
        descriptors: ``(n, D)`` float32 or uint8.
    """

    points_xy: NDArray[np.float64]
    sizes: NDArray[np.float64]
    angles_rad: NDArray[np.float64]
    responses: NDArray[np.float32]
    descriptors: NDArray[np.float32] | NDArray[np.uint8]


@dataclass(frozen=True)
class Detector:
    """One of OpenCV's detectors with its descriptor, without their known position errors.

    * ``sift`` runs with ``enable_precise_upscale``: without it positions are off by ¼ pixel.
    * ``orb``: positions found in downscaled images are mapped back from edge to edge. OpenCV's
      are off by up to a pixel and more where sizes are not divisible.

    Args:
        name: ``sift`` or ``orb``.

    Raises:
        SettingError: The name is unknown.
    """

    name: str = "sift"

    def __post_init__(self) -> None:
        if self.name not in ("sift", "orb"):
            raise SettingError("detector", found=repr(self.name), expected="sift or orb")

    @property
    def norm(self) -> Literal["l2", "hamming"]:
        """Descriptor distance: L2 for float32, Hamming for uint8 bits."""
        return "l2" if self.name == "sift" else "hamming"

    def detect(self, gray: NDArray[np.uint8]) -> Detections:
        """Detect and describe keypoints. Several threads may call it at once.

        Args:
            gray: ``(h, w)`` uint8.

        Returns:
            All keypoints, in OpenCV's order. SIFT finds none within 1¾ pixels of the borders, ORB
            none within 31.
        """
        if self.name == "sift":
            engine = _cv2.SIFT_create(enable_precise_upscale=True)
        else:
            engine = _cv2.ORB_create(2**24, _ORB_SCALE)  # all; the strongest are chosen later
        points: Any = ()
        if min(gray.shape) >= _SMALLEST_SIDE:
            points, descriptors = engine.detectAndCompute(np.ascontiguousarray(gray), None)
        if not len(points):
            kind = np.float32 if self.norm == "l2" else np.uint8
            descriptors = np.empty((0, engine.descriptorSize()), kind)
        table = [(*p.pt, p.size, p.angle, p.response, p.octave) for p in points]
        values = np.array(table, np.float64).reshape(-1, 6)
        places = values[:, :2]
        if self.name == "orb":
            scale = _ORB_SCALE ** values[:, 5:]
            size = np.array(gray.shape[::-1])
            places = (places / scale + 0.5) * size / np.rint(size / scale) - 0.5
        responses = values[:, 4].astype(np.float32)
        return Detections(places, values[:, 2], np.deg2rad(values[:, 3]), responses, descriptors)

    def strongest(self, keypoints: SphericalKeypoints) -> SphericalKeypoints:
        """The keypoints of a panorama that are kept: all of SIFT's, the strongest of ORB's."""
        if self.name == "sift" or len(keypoints) <= _ORB_KEYPOINTS:
            return keypoints
        order = np.argsort(-keypoints.responses, kind="stable")
        return keypoints.select(np.sort(order[:_ORB_KEYPOINTS]))


def detect_on_equirect(image: NDArray[np.uint8], detector: Detector) -> SphericalKeypoints:
    """Detect keypoints on a panorama as if it were an ordinary image, but across ±180°.

    The image is extended by W/8 columns of its other side, left and right, so that keypoints at
    ±180° are found once. It is not extended beyond the poles, as in the paper's baseline.

    Args:
        image: ``(H, W)`` grey or ``(H, W, 3)`` RGB, uint8.
        detector: The detector.
    """
    gray = _gray(image)
    height, width = gray.shape
    pad = -(-width // _WRAP_SHARE)
    found = detector.detect(np.pad(gray, ((0, 0), (pad, pad)), mode="wrap"))
    found.points_xy[:, 0] -= pad
    u = found.points_xy[:, 0]
    directions = lonlat_to_xyz(equirect_to_lonlat(found.points_xy, (height, width)))
    keypoints = _on_sphere(found, directions, equirect_jacobian(directions, (height, width)), 0)
    return detector.strongest(keypoints.select((u >= -0.5) & (u < width - 0.5)))


def detect_on_tangent_images(
    image: NDArray[np.uint8], grid: TangentGrid | CubeGrid, detector: Detector, margin: int = 32
) -> SphericalKeypoints:
    """Detect keypoints on the tangent images of a panorama, or on the faces of a cube.

    Images overlap, and duplicates would spoil the ratio test: a keypoint is kept by the image that
    owns its direction, and only once where two images find it on their common border. Where each
    finds it in the other's cell it is lost, about one in 500 at base level 2.

    Args:
        image: ``(H, W)`` grey or ``(H, W, 3)`` RGB, uint8.
        grid: The images.
        detector: The detector.
        margin: Pixels added on every side of the images, at the same pitch: detectors find nothing
            near borders, and large keypoints need space.

    Returns:
        Keypoints in the order of the faces they were detected in.
    """
    gray = _gray(image)
    wide = grid.widened(margin)

    def search(face: int) -> SphericalKeypoints:
        found = detector.detect(equirect_to_tangent(gray, wide, [face])[0])
        plane = (found.points_xy - (wide.dim - 1) / 2) * wide.pitch
        rays = np.column_stack([plane, np.ones(len(plane))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        directions = rays @ wide.world_from_camera[face].T
        jacobian = gnomonic_jacobian(directions, wide, face)
        keypoints = _on_sphere(found, directions, jacobian, face)
        return keypoints.select(wide.owners(directions) == face)

    threads = min(torch.get_num_threads(), max(1, _PIXELS_AT_ONCE // wide.dim**2))
    with ThreadPoolExecutor(threads) as pool:
        parts = list(pool.map(search, range(wide.num_images)))
    keypoints = SphericalKeypoints.concatenated(parts)
    return detector.strongest(keypoints.select(~_repeated(keypoints, wide.pitch)))


def gnomonic_jacobian(
    directions_xyz: NDArray[np.float64], grid: PinholeGrid, face: int
) -> NDArray[np.float64]:
    """Jacobian of directions by pixel in a tangent image, ``∂d/∂(column, row)``.

    At (X, Y) on the tangent plane, with r² = 1 + X² + Y², pitch p and the camera's axes
    A = (a, b, c): ``d = A (X, Y, 1) / r``, ``∂d/∂(column, row) = p/r · (I − d dᵀ) (a, b)``.

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
    """``(n,)`` the weaker of each two that are one keypoint, found on both sides of a border."""
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
