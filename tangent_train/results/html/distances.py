"""Pack distances for the report's viewer, which shows them as colors and as points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import equirect_directions
from tangent_train.heads.pictures import distance_limits

_STEPS = 65534  # between the nearest and the farthest distance
_FAR = 4  # medians of the distance: points beyond do not count for the middle of the scene
_OUTER = 2, 98  # percentiles of their coordinates


class DistanceScale(NamedTuple):
    """Meaning of the 16-bit values of maps of distances, and the scene of their points.

    Value k of a pixel, 256 red + green, is ``near · (far / near) ** ((k - 1) / 65534)``; 0 is
    unknown. Rounding changes a distance by a factor of at most ``(far / near) ** (1 / 131068)``:
    3.6e-5 of it between 0.1 m and 10 m.

    Attributes:
        near: Distance of value 1.
        far: Distance of value 65535.
        limits: Distances of the first and the last color.
        is_metric: True for meters; False for distances up to a scale.
        camera: Focal lengths and principal point of a photo, ``fx, fy, cx, cy``, in widths and
            heights from its upper left corner. Its maps are z-depth. None for panoramas, and for
            photos without a camera matrix, which have no points.
        center: Middle of the points: ahead, right, up.
        radius: Radius of most points around the center.
    """

    near: float
    far: float
    limits: tuple[float, float]
    is_metric: bool
    camera: tuple[float, ...] | None
    center: tuple[float, ...]
    radius: float


def camera_in_sides(camera_matrix: NDArray[np.float64], size: Sequence[int]) -> tuple[float, ...]:
    """Return a photo's camera in widths and heights, see `DistanceScale`.

    Args:
        camera_matrix: ``(3, 3)`` K for integer pixel centers.
        size: ``(height, width)`` of the photo.
    """
    (fx, _, cx), (_, fy, cy), _ = camera_matrix.tolist()
    height, width = size[:2]
    return fx / width, fy / height, (cx + 0.5) / width, (cy + 0.5) / height


def pack_distances(
    distances: Mapping[str, NDArray[np.floating]],
    camera: tuple[float, ...] | None,
    *,
    sphere: bool,
    is_metric: bool,
) -> tuple[DistanceScale, dict[str, NDArray[np.uint8]]]:
    """Pack maps of distances on one scale.

    Args:
        distances: Maps ``(h, w)``, of z-depth with a camera; NaN, infinite and 0 are unknown. The
            last one defines the middle of the scene.
        camera: Camera of a photo, see `DistanceScale`.
        sphere: True for panoramas.
        is_metric: True for meters.

    Returns:
        Scale, and images ``(h, w, 3)`` of the packed maps in OpenCV's order of the channels.
    """
    maps = {
        key: np.where(np.isfinite(d) & (d > 0), d.astype(np.float64), np.nan)
        for key, d in distances.items()
    }
    center: tuple[float, ...] = (0.0, 0.0, 0.0)
    radius = 1.0
    if sphere or camera:
        *_, last = maps.values()
        center, radius = _scene(_rays(last.shape, camera) * last[..., None])
    known = np.concatenate([values[values > 0] for values in maps.values()])
    near = float(known.min()) if known.size else 1.0
    far = max(float(known.max(initial=near)), 1.01 * near)
    limits = distance_limits(known)
    packed = {}
    for key, values in maps.items():
        steps = np.rint(_STEPS * np.log(values / near) / np.log(far / near)) + 1
        high, low = np.divmod(np.nan_to_num(steps).astype(np.uint16), 256)
        packed[key] = np.stack([0 * low, low, high], axis=-1).astype(np.uint8)
    return DistanceScale(near, far, limits, is_metric, camera, center, radius), packed


def _rays(shape: tuple[int, ...], camera: tuple[float, ...] | None) -> NDArray[np.float64]:
    """Return the points of a map's pixels at distance 1, of photos at z-depth 1.

    Returns:
        ``(h, w, 3)``: ahead, right, up.
    """
    if camera is None:
        return equirect_directions((shape[0], shape[1]))
    fx, fy, cx, cy = camera
    right = ((np.arange(shape[1]) + 0.5) / shape[1] - cx) / fx
    up = (cy - (np.arange(shape[0]) + 0.5) / shape[0]) / fy
    return np.stack([np.ones(shape), *np.meshgrid(right, up)], axis=-1)


def _scene(points: NDArray[np.float64]) -> tuple[tuple[float, ...], float]:
    """Return middle and radius of most points, without those that are far away, e.g. the sky."""
    points = points[np.isfinite(points[..., 0])]
    if not len(points):
        return (0.0, 0.0, 0.0), 1.0
    lengths = np.linalg.norm(points, axis=-1)
    near = points[lengths <= _FAR * np.median(lengths)]
    least, most = np.percentile(near, _OUTER, axis=0)
    return tuple(((least + most) / 2).tolist()), float(np.linalg.norm(most - least) / 2)
