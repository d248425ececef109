"""Cameras of views, for networks that take all views of a panorama in one call.

All axes are right-handed, as in COLMAP and OpenCV. Those of a camera are x to the right, y down, z
ahead; those of the world x ahead (the middle of the panorama), y to the left, z up.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor


def cameras_of_rays(
    rays: Float[Tensor, "views 3 3"], size: tuple[int, int]
) -> tuple[Float[Tensor, "views 3 3"], Float[Tensor, "views 3 3"]]:
    """Return ``world_from_camera`` and ``camera_matrix`` of views.

    Args:
        rays: See `Views.rays`.
        size: Rows and columns of the images.

    Returns:
        Rotations, and matrices K in pixels; the center of the first pixel is (0, 0).
    """
    lengths = rays.norm(dim=1)
    to_right_handed = rays.new_tensor([1.0, -1.0, 1.0])[:, None]
    pixels = rays.new_tensor([size[1], size[0]])
    camera_matrix = torch.eye(3).to(rays).repeat(len(rays), 1, 1)
    camera_matrix[:, [0, 1], [0, 1]] = pixels / 2 * lengths[:, 2:] / lengths[:, :2]
    camera_matrix[:, :2, 2] = (pixels - 1) / 2
    return to_right_handed * rays / lengths[:, None], camera_matrix


def rotation_error_deg(
    predicted: Float[Tensor, "views 3 3"], known: Float[Tensor, "views 3 3"]
) -> Float[Tensor, ""]:
    """Return the mean angle between predicted and known rotations, in degrees.

    The world of the predicted ones is first rotated to that of the known ones by least squares
    (Kabsch 1976). The angle θ follows from the chord: ‖R − 1‖ = √8 sin(θ / 2).
    """
    u, _, v = torch.linalg.svd((known @ predicted.mT).sum(dim=0).double())
    u[:, 2] *= torch.linalg.det(u @ v)
    chord = ((u @ v).to(known) @ predicted - known).norm(dim=(1, 2))
    return torch.rad2deg(2 * (chord / math.sqrt(8)).clamp(max=1).asin()).mean()
