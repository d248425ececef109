"""Samples of shapes: views of their spheres, and the input of a network."""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datamodules.core.dataset import SplitDataset
from datamodules.core.inputs import Normalization, normalize_channels
from datamodules.core.loading import sample_key, sample_rng
from tangent_train.geometry import random_rotation, rotation_about

SPHERE_NORMALIZATION = Normalization(
    mean=(0.7139, 0.6936, 0.5851, 0.5336, 0.7626, 0.5651),
    std=(0.2797, 0.2606, 0.2737, 0.2144, 0.1987, 0.2440),
)
"""The six channels of `mesh_spheres` over ModelNet40 (the released code of the paper)."""

TestRotation = Literal["yaw", "so3"] | None
"""Rotation of test shapes: about the vertical, uniformly random (SO(3)), or none."""


STEPS = 16384
"""Steps of prepared values per unit.

Distances are at most 1.99, so 15 bits hold all values with an error of at most 1/32768, less than
2/10000 of a channel's standard deviation. Float16 would take as much space and be eight times as
coarse around 1, and OpenCV does not sample it.
"""


class Spheres(NamedTuple):
    """A mesh as seen from the sphere around it.

    Attributes:
        spheres: ``(H, W, 6)`` uint16 in steps of `STEPS`, see `mesh_spheres`.
    """

    spheres: NDArray[np.uint16]


class ShapeSample(NamedTuple):
    """N views of one shape; collating adds a leading batch dimension.

    Attributes:
        images: ``(N, h, w, 6)`` int16 in steps of `STEPS`, which is half the bytes.
            `normalize_spheres` converts them to ``(N, 6, h, w)`` float32 on the device.
        label: Class, int64.
        index: Index in its split, int64.
    """

    images: Tensor
    label: Tensor
    index: Tensor  # type: ignore[assignment]  # hides tuple.index


class ShapeViews(SplitDataset):
    """Views of shapes, by index or (epoch, index).

    They are drawn for every epoch and index in training, and all in evaluation.
    """

    def __getitem__(self, key: int | tuple[int, int]) -> ShapeSample:
        epoch, index = sample_key(key, len(self))
        spheres = self.read(index).spheres
        images = np.concatenate([v.render(spheres, "bilinear") for v in self._views(epoch, index)])
        # torch has few operations on uint16; all values are below 2 · STEPS = 2¹⁵.
        return ShapeSample(
            torch.from_numpy(np.require(images, requirements="W").view(np.int16)),
            torch.tensor(self.data.class_names.index(self.files[index].label)),
            torch.tensor(index),
        )

    def _views(self, epoch: int, index: int) -> list[Any]:
        data, representation = self.data, self.data.representation
        if self.split == "train":
            rng = sample_rng((data.seed, data.sampling_seed), epoch, index)
            return [representation.sample(rng)]
        if self.split == "val" or data.test_rotation is None:
            views: list[Any] = representation.view_sets()
        else:  # rotated back, it sees what a rotated shape shows
            rotation = shape_rotation(data.test_rotation, data.seed, index)
            views = representation.with_rotation(rotation.T).view_sets()
        return views


def shape_rotation(kind: TestRotation, seed: int, index: int) -> NDArray[np.float64]:
    """Return the rotation R of one shape, ``(3, 3)``: point x moves to R x."""
    rng = sample_rng(seed, 0, index)
    if kind == "so3":
        return random_rotation(rng)
    return rotation_about((0, 0, 1), rng.uniform(0, 2 * math.pi))


def normalize_spheres(images: Tensor, normalization: Normalization) -> Tensor:
    """Normalize to a network's input, channels first.

    Args:
        images: ``(..., h, w, 6)`` int16 in steps of `STEPS`.
        normalization: Normalization of six channels.

    Returns:
        ``(..., 6, h, w)`` float32, on the same device.
    """
    *batch, height, width, channels = images.shape
    values = images.new_empty((*batch, channels, height, width), dtype=torch.float32)
    values.copy_(images.movedim(-1, -3))
    return normalize_channels(values, [STEPS] * channels, normalization)
