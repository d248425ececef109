"""Panoramas and photos of any data set: their files, decoding, sizes and unknown pixels.

RGB, depth and labels of a panorama are resized to the size that a run reads on **one** pixel
grid: the outer edges of source and target agree, so target row i covers source rows
``i · H / h`` to ``(i + 1) · H / h``. RGB is averaged over that area; labels and depth are taken
from the source pixel at its center.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import ray_lengths
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering.resampling import resize

if TYPE_CHECKING:
    from tangent_train.rendering.representations.views import Sampler

Labels = NDArray[np.unsignedinteger[Any]]
"""Labels ``(H, W)``, 0 where unknown: uint8 classes, or uint16 distances in steps of 1/512 m."""

Unknown = Literal["labels", "any_black", "all_black"]
"""Pixels that are unknown in addition to unlabeled pixels; see `mask_black`."""

STEPS_PER_M = 512
"""Steps of depth per meter, as in the files of Stanford2D3DS."""


MOST_STEPS = np.iinfo(np.uint16).max
"""Largest distance in 16 bits, about 128 m."""


class ImageFiles(NamedTuple):
    """The files of one panorama or photo.

    Attributes:
        name: Unique short name; ``/`` between groups.
        rgb: Color image.
        labels: File of class labels; None if the labels are distances.
        depth: Depth image, if depth is an input or the labels are distances.
        camera: File with the camera matrix, for photos with one file each.
    """

    name: str
    rgb: Path
    labels: Path | None = None
    depth: Path | None = None
    camera: Path | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files of the image."""
        return tuple(path for path in self[1:] if path is not None)


class Image(NamedTuple):
    """One panorama or photo.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        depth: ``(H, W)`` uint16 distance from the center in steps of 1/512 m, 0 where missing; None
            if not read. Before `ImageDataModule.read`, z-depth of photos.
        labels: ``(H, W)`` uint8 classes, 0 where unknown; or uint16 distances like `depth`, which
            is then None.
        up: ``(3,)`` direction of the zenith in a panorama, a unit vector; None if it is z.
        valid: ``(H, W)`` bool, the recorded pixels of a panorama; None if all are. Elsewhere,
            labels and depth are 0, and colors are filled.
        camera_matrix: ``(3, 3)`` K of a photo for integer pixel centers, without skew; None for a
            panorama.

    The arrays may be shared or read-only: not to be written to.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None
    labels: Labels
    up: NDArray[np.float64] | None = None
    valid: NDArray[np.bool_] | None = None
    camera_matrix: NDArray[np.float64] | None = None

    @property
    def distance_m(self) -> NDArray[np.float32] | None:
        """``(H, W)`` distance from the center in meters, NaN where missing; None if not read."""
        steps: Any = self.labels if self.labels.dtype == np.uint16 else self.depth
        return None if steps is None else steps_to_meters(steps)

    def sampler(self, representation: Any) -> Sampler:
        """Return the sampler of its views: of a panorama aligned with gravity, of a photo crops."""
        sampler: Sampler = representation
        if self.camera_matrix is not None:
            height, width = self.labels.shape
            sampler = representation.of_camera(self.camera_matrix, (height, width))
        elif self.up is not None:
            sampler = representation.with_rotation(upright_rotation(self.up))
        return sampler

    def target(self, representation: Any) -> Labels:
        """Return the labels that predictions are compared with.

        They are all labels of a panorama, and ``(n, d, d)`` labels of the crops of a photo, in
        which every pixel of the photo counts once.
        """
        if self.camera_matrix is None:
            return self.labels
        (crops,) = representation.of_camera(self.camera_matrix, self.labels.shape).view_sets()
        return np.where(crops.owned(), crops.render(self.labels, "nearest"), np.uint8(0))


def resize_depth(depth: NDArray[np.uint16], shape: tuple[int, int]) -> NDArray[np.uint16]:
    """Downsample raw depth ``(H, W)``, 0 where missing, without mixing values.

    Like the nearest pixel, but where the center pixel is missing, the nearest valid pixel within
    the area of the target pixel is taken.
    """
    small = resize(depth, shape, "nearest")
    holes = np.nonzero(small == 0)
    scale = [source / target for source, target in zip(depth.shape, shape, strict=True)]
    centers = [(i + 0.5) * s for i, s in zip(holes, scale, strict=True)]
    # The first source pixel whose center lies in the area of the target pixel.
    first = [np.ceil(i * s - 0.5).astype(np.intp) for i, s in zip(holes, scale, strict=True)]
    nearest = np.full(len(holes[0]), np.inf)
    for step in np.ndindex(math.ceil(scale[0]), math.ceil(scale[1])):
        pixel = [np.minimum(f + d, n - 1) for f, d, n in zip(first, step, depth.shape, strict=True)]
        away = [np.abs(p + 0.5 - c) for p, c in zip(pixel, centers, strict=True)]
        inside = (away[0] <= scale[0] / 2) & (away[1] <= scale[1] / 2)
        distance = np.hypot(*away)
        value = depth[pixel[0], pixel[1]]
        better = inside & (value > 0) & (distance < nearest)
        small[holes[0][better], holes[1][better]] = value[better]
        nearest[better] = distance[better]
    return small


def mask_black(labels: Labels, rgb: NDArray[np.uint8], unknown: Unknown) -> Labels:
    """Make black pixels unknown.

    The paper's released code applies `any_black` in training and evaluation, before resizing. This
    function does the same at the pixels that the labels are taken from.

    Args:
        labels: ``(H, W)``.
        rgb: ``(H, W, 3)`` at the same pixels.
        unknown: `labels` changes nothing; `any_black` makes pixels unknown where any channel is 0;
            `all_black` where all channels are 0.

    Returns:
        ``(H, W)`` labels.
    """
    if unknown == "labels":
        return labels
    black = rgb == 0
    return np.where(black.any(-1) if unknown == "any_black" else black.all(-1), np.uint8(0), labels)


def steps_to_meters(steps: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Convert depth in steps of 1/512 m to meters, float32, NaN where missing."""
    meters = steps.astype(np.float32) / np.float32(STEPS_PER_M)
    return np.where(steps == 0, np.float32(np.nan), meters)


def meters_to_steps(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert depth in meters to steps of 1/512 m, rounded, at most 65535 (128 m).

    Depth below half a step is rounded up to one step: 0 means missing.

    >>> meters_to_steps(np.array([0, 1e-4, 1, 1000], np.float32)).tolist()
    [0, 1, 512, 65535]
    """
    steps = np.minimum(depth_m * np.float32(STEPS_PER_M) + np.float32(0.5), MOST_STEPS)
    return np.maximum(steps.astype(np.uint16), depth_m > 0)


def units_to_steps(stored: NDArray[np.uint16], units_per_m: int) -> NDArray[np.uint16]:
    """Convert 16-bit depth in integer units to steps of 1/512 m, see `meters_to_steps`.

    >>> units_to_steps(np.array([0, 1, 4000, 65535], np.uint16), 4000).tolist()
    [0, 1, 512, 8388]
    """
    # In integers, because float32 would round some values of 16 bits to the wrong step.
    steps = (stored.astype(np.int64) * 2 * STEPS_PER_M + units_per_m) // (2 * units_per_m)
    return np.maximum(np.minimum(steps, MOST_STEPS).astype(np.uint16), stored > 0)


def distance_from_z_depth(
    z_depth: NDArray[np.uint16], camera_matrix: NDArray[np.float64]
) -> NDArray[np.uint16]:
    """Convert z-depth to the distance from the center of projection, as in panoramas.

    Args:
        z_depth: ``(H, W)`` depth along the optical axis in any unit, 0 where missing.
        camera_matrix: ``(3, 3)`` K for integer pixel centers.

    Returns:
        ``(H, W)`` in the same unit, rounded, at most 65535; 0 where missing.
    """
    lengths = ray_lengths(camera_matrix, z_depth.shape)
    return np.minimum(z_depth * lengths + 0.5, MOST_STEPS).astype(np.uint16)
