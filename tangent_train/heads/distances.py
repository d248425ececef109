"""Convert the output of depth networks to distances along the rays of their images."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from tangent_train.checkpoints.kinds import DepthKind

_FARTHEST_M = 1e4

RAY_POWERS: dict[str, int] = {
    "metric_distance": 0,
    "metric_z": 1,
    "relative_depth": 1,
    "relative_disparity": -1,
}
"""Powers of the ray length that convert depth, or disparity, to that along the ray."""


def is_disparity(kind: DepthKind) -> bool:
    """Return True if views are blended in disparity, False if in the logarithm of distance."""
    return kind == "relative_disparity"


def is_metric(kind: DepthKind) -> bool:
    """Return True if distances are in meters, False if only their ratios are known."""
    return not kind.startswith("relative")


def depth_of_output(
    output: Tensor, kind: DepthKind, ray_lengths: Tensor
) -> tuple[Tensor, DepthKind]:
    """Convert `log_distance` and `canonical_inverse` to meters; others are returned unchanged.

    The canonical inverse depth C is divided by the focal length in image widths (Bochkovskii et al.
    2024, section 3.2). That follows from the rays: at columns of distance d, the second difference
    of 1 + x² is 2 (d p)², with the pitch p of pixels on the image plane. Depth is at most 10 km, as
    in the authors' code.

    Args:
        output: Output of a network for whole images, ``(n, 1, h, w)``.
        kind: Kind of the output.
        ray_lengths: ``(1 or n, 1, h, w)``, see `Views.ray_lengths`.

    Returns:
        Depth, and its kind, which is in `RAY_POWERS`.
    """
    if kind == "log_distance":
        return output.exp(), "metric_distance"
    if kind == "canonical_inverse":
        inverse = output * _span(ray_lengths)
        return 1 / inverse.clamp(1 / _FARTHEST_M, _FARTHEST_M), "metric_z"
    return output, kind


def _span(ray_lengths: Tensor) -> Any:
    """Return the width of images ``(…, h, w)`` on the image plane at distance 1."""
    width = ray_lengths.shape[-1]
    if width == 1:  # not a pinhole image: the radians of an equirectangular image
        return 2 * math.pi
    half = (width - 1) // 2
    left, middle, right = ray_lengths[..., [0, half, 2 * half]].square().unbind(-1)
    squared = ((left + right) / 2 - middle).mean(-1)[..., None, None]
    return squared.sqrt() * width / half


def along_rays(depth: Tensor, kind: DepthKind, ray_lengths: Tensor) -> Tensor:
    """Convert depth to the quantity in which views are blended.

    Args:
        depth: Values of the kind.
        kind: Kind of the values, see `depth_of_output`.
        ray_lengths: Distance divided by z-depth at each pixel, see `Views.ray_lengths`.

    Returns:
        Disparity along the ray, 1 / distance, for `relative_disparity`; for other kinds the natural
        logarithm of the distance. NaN where the depth is not finite, or not positive where its
        logarithm is taken.
    """
    values = depth * ray_lengths ** RAY_POWERS[kind]
    values = values if is_disparity(kind) else values.log()
    return values.where(values.isfinite(), torch.nan)


def from_distance(distance: Tensor, kind: DepthKind, ray_lengths: Tensor) -> Tensor:
    """Convert distances along the rays to the output of a network: the inverse of `distance_of`.

    Args:
        distance: Distances ``(n, …, h, w)``.
        kind: Kind of the result.
        ray_lengths: Distance divided by z-depth at each pixel, see `Views.ray_lengths`.
    """
    if kind == "log_distance":
        return distance.log()
    if kind == "canonical_inverse":
        return ray_lengths / (distance * _span(ray_lengths))
    values = 1 / distance if is_disparity(kind) else distance
    return values * ray_lengths ** -RAY_POWERS[kind]


def distance_of(values: Tensor, kind: DepthKind) -> Tensor:
    """Convert blended values, see `along_rays`, to distances; NaN where disparity is ≤ 0."""
    if not is_disparity(kind):
        return values.exp()
    return (1 / values).where(values > 0, torch.nan)
