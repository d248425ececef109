"""Training and evaluation samples, and their parts rendered from images."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torchvision.transforms.v2 import functional

from datamodules.core.images import STEPS_PER_M, Image
from datamodules.core.inputs import MAX_DEPTH_M, Input
from tangent_train.geometry import equirect_elevations
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering.representations.views import Views

Inputs = Sequence[Tensor]
"""Rendered RGB, optionally depth and elevation, see `TrainingSample`."""

_Images = TypeVar("_Images", Inputs, Tensor)


class TrainingSample(NamedTuple, Generic[_Images]):
    """P views of one panorama or photo; collating adds a leading batch dimension.

    Attributes:
        images: As rendered, to save bytes: RGB ``(P, h, w, 3)`` uint8, optionally depth
            ``(P, h, w)`` int16 and elevation ``(P, h, w)`` float32. `normalize` converts them to
            ``(P, C, h, w)`` float32 on the device.
        labels: ``(P, h, w)`` uint8, or int32 for distances, 0 where unknown.
        rays: ``(P, 3, 3)`` float32 viewing rays, see `world_rays`; or ``(0, 3, 3)``.
        ray_lengths: ``(1 or P, h, w)`` float32, see `Views.ray_lengths`, for distances as labels;
            else a 1, ``(1, 1, 1)``.
        index: Index in its split.
    """

    images: _Images
    labels: Tensor
    rays: Tensor
    ray_lengths: Tensor
    index: int  # type: ignore[assignment]  # hides tuple.index


class EvaluationSample(NamedTuple, Generic[_Images]):
    """One whole panorama or photo; collating adds a leading batch dimension.

    Attributes:
        images: Views of all view sets, one set after the other, as in `TrainingSample`.
        target: Labels as in `TrainingSample`: ``(H, W)`` of a panorama; ``(N, h, w)`` of the crops
            of a photo.
        rotation: ``(3, 3)`` float64 rotation of the representation that aligns it with gravity.
        ray_lengths: As in `TrainingSample`, of each view set of a panorama or each crop of a photo.
        valid: ``(H, W)`` bool, valid pixels of a partial panorama; ``(0, 0)`` for other images.
        index: Index in its split.
    """

    images: _Images
    target: Tensor
    rotation: Tensor
    ray_lengths: Tensor
    valid: Tensor
    index: int  # type: ignore[assignment]  # hides tuple.index


def valid_mask(valid: Tensor) -> NDArray[np.bool_] | None:
    """Return the mask of `EvaluationSample.valid`; None if all pixels are valid."""
    return valid.cpu().numpy() if valid.numel() else None


def render_inputs(image: Any, views: Views, inputs: Sequence[Input]) -> tuple[Tensor, ...]:
    """Render the inputs of a network, before `normalize`.

    Args:
        image: A panorama or photo, with `depth` if depth is an input.
        views: Views of the image.
        inputs: See `Input`.

    Returns:
        RGB ``(n, h, w, 3)`` uint8; with depth, ``(n, h, w)`` int16 steps up to `MAX_DEPTH_M`; with
        elevation, ``(n, h, w)`` float32.
    """
    rendered = [as_tensor(views.render(image.rgb, "bilinear"))]
    if "depth" in inputs and image.depth is not None:
        steps = np.minimum(views.render(image.depth, "nearest"), int(MAX_DEPTH_M * STEPS_PER_M))
        # torch has few operations on uint16.
        rendered.append(torch.from_numpy(steps.view(np.int16)))
    if "elevation" in inputs:
        shape = (image.rgb.shape[0], image.rgb.shape[1])
        up = image.up
        elevations = _upright_elevations(shape) if up is None else equirect_elevations(shape, up)
        rendered.append(as_tensor(views.render(elevations, "bilinear")))
    return tuple(rendered)


def world_rays(views: Views, up: NDArray[np.float64] | None) -> NDArray[np.float32]:
    """Return viewing rays in a world whose zenith is z, see `Views.rays`.

    Args:
        views: Views of a panorama.
        up: Zenith of the panorama; None if it is z.
    """
    rays = views.rays()
    return rays if up is None else upright_rotation(up).T.astype(np.float32) @ rays


@lru_cache(maxsize=2)
def _upright_elevations(shape: tuple[int, int]) -> NDArray[np.float32]:
    elevations = equirect_elevations(shape)
    elevations.setflags(write=False)
    return elevations


def as_tensor(array: NDArray[Any]) -> Tensor:
    """Return a rendered array as a tensor."""
    # The rendered array may be the panorama itself, shared or a read-only file: copy it.
    return torch.from_numpy(array) if array.flags.owndata else torch.tensor(array)


def view_ray_lengths(view_sets: Sequence[Views], image: Image) -> Tensor:
    """Return the ray lengths of sets of views if the labels are distances; else a 1."""
    if image.labels.dtype != np.uint16:
        return torch.ones(1, 1, 1)
    return torch.from_numpy(np.concatenate([views.ray_lengths() for views in view_sets]))


def for_torch(labels: NDArray[Any]) -> NDArray[Any]:
    """Return labels as a type that torch computes with."""
    # torch has few operations on uint16.
    return labels.astype(np.int32) if labels.dtype == np.uint16 else labels


_HUE_SHARE = 0.1


def jitter_colors(rgb: Tensor, strength: float, rng: np.random.Generator) -> Tensor:
    """Change brightness, contrast, saturation and (slightly) hue, equally for all images.

    Args:
        rgb: ``(n, h, w, 3)`` uint8, views of one panorama or photo.
        strength: 0 to 1. The factors of the first three are uniform in 1 ± strength, hue is
            rotated by up to strength / 10 of the circle either way.
        rng: Random generator; four numbers are drawn.

    Returns:
        ``(n, h, w, 3)`` uint8.
    """
    brightness, contrast, saturation = rng.uniform(1 - strength, 1 + strength, 3)
    hue = rng.uniform(-1, 1) * strength * _HUE_SHARE
    # As one tall image: with one mean for all, neighboring views keep equal colors at seams.
    image = rgb.flatten(0, 1).movedim(-1, 0)
    image = functional.adjust_brightness(image, brightness)
    image = functional.adjust_contrast(image, contrast)
    image = functional.adjust_saturation(image, saturation)
    image = functional.adjust_hue(image, hue)
    return image.movedim(0, -1).reshape(rgb.shape)
