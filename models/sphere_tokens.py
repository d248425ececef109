"""Few tokens for the features of an image, where they look, and the way back to features."""

from __future__ import annotations

import math
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["add_tokens", "lone_rays", "to_tokens", "token_directions"]

_Size = Any
"""An int; while exporters trace, a symbol or a tensor of one."""


def to_tokens(
    features: Float[Tensor, "images channels height width"], most: int
) -> Float[Tensor, "images channels rows columns"]:
    """Average features to at most `most` rows and columns, as adaptive pooling does.

    Written as two products with matrices of the sizes at hand, so that exporters can leave height
    and width open, which they cannot for adaptive pooling.

    Args:
        features: Of any size; a side that is not longer than `most` stays as it is.
        most: Rows and columns.
    """
    rows, columns = (_members(side, most, features) for side in features.shape[-2:])
    # Sums first: of 0 and 1 even half precision rounds none.
    return (rows @ features @ columns.mT) / (rows.sum(1)[:, None] * columns.sum(1))


def add_tokens(
    features: Float[Tensor, "images channels height width"],
    tokens: Float[Tensor, "images channels rows columns"],
) -> Float[Tensor, "images channels height width"]:
    """Add tokens to features, enlarged bilinearly, in the dtype and layout of the features."""
    down, across = (
        _bilinear_matrix(wanted, given, tokens)
        for wanted, given in zip(features.shape[-2:], tokens.shape[-2:], strict=True)
    )
    return features + (down @ tokens @ across.mT).to(features.dtype)


def token_directions(
    rays: Float[Tensor, "spheres images 3 3"], rows: _Size, columns: _Size
) -> Float[Tensor, "spheres images 3 rows columns"]:
    """Unit vectors that the centres of tokens look along.

    Args:
        rays: They map image coordinates (x, y, 1) to vectors of any length, x from −1 on the left
            edge of the image to 1 on the right one, y from −1 on the upper edge to 1 on the lower.
        rows: Of tokens.
        columns: Of tokens.
    """
    y = _centers(rows, rays)[:, None]
    x = _centers(columns, rays)
    along_x, along_y, along_z = rays[..., None, None].unbind(3)
    # No matrix product: with autocast it would be one of half precision.
    vectors = along_x * x + along_y * y + along_z
    return vectors / torch.linalg.vector_norm(vectors, dim=2, keepdim=True)


def lone_rays(
    images: Float[Tensor, "images channels height width"], fov_deg: float
) -> Float[Tensor, "images 1 3 3"]:
    """Rays of images that are alone on their spheres: of a camera held level that looks along x.

    Args:
        images: Of square pixels.
        fov_deg: Angle that their width spans.
    """
    height, width = images.shape[-2:]
    half = math.tan(math.radians(fov_deg) / 2)
    dtype = torch.promote_types(images.dtype, torch.float32)
    # The axes of camera images (right, down, forward) in the sphere's frame are y, −z and x.
    axes = [[0.0, 0.0, 1.0], [half, 0.0, 0.0], [0.0, -half, 0.0]]
    one = torch.ones((), dtype=dtype, device=images.device)
    scales = torch.stack([one, one * height / width, one])
    rays = torch.tensor(axes, dtype=dtype, device=images.device) * scales
    return rays.expand(images.shape[0], 1, 3, 3)


def _centers(count: _Size, like: Tensor) -> Tensor:
    """Coordinates of the centres of so many tokens, from −1 to 1 over the image."""
    return (2 * torch.arange(count, dtype=like.dtype, device=like.device) + 1) / count - 1


def _members(side: _Size, most: int, like: Tensor) -> Tensor:
    """``(tokens, side)``: 1 where a row or column of features is in the average of a token."""
    count = _at_most(side, most)
    token = torch.arange(count, device=like.device)[:, None]
    place = torch.arange(side, device=like.device)
    begin = token * side // count
    end = ((token + 1) * side + count - 1) // count
    return ((place >= begin) & (place < end)).to(like.dtype)


def _bilinear_matrix(side: _Size, count: _Size, like: Tensor) -> Tensor:
    """``(side, tokens)``: the share of every token in rows or columns of features."""
    place = torch.arange(side, device=like.device, dtype=torch.float32)
    position = ((place + 0.5) * count / side - 0.5).clamp(min=0)
    position = torch.minimum(position, torch.ones_like(position) * (count - 1))
    token = torch.arange(count, device=like.device, dtype=torch.float32)
    return (1 - (position[:, None] - token).abs()).clamp(min=0).to(like.dtype)


def _at_most(side: _Size, most: int) -> _Size:
    """The lesser of both."""
    return side.clamp(max=most) if isinstance(side, Tensor) else torch.sym_min(side, most)
