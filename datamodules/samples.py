"""From labelled images to what a network is trained and evaluated on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, default_collate

from datamodules.colors import jitter_colors
from datamodules.panoramas import STEPS_PER_M
from datamodules.sampling import Seed, sample_rng
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from datamodules.sources import ImageSource, LabelledImage
    from tangent_train.rendering.representation import Views

__all__ = [
    "RGBD_NORMALIZATION",
    "RGB_NORMALIZATION",
    "EvaluationImages",
    "EvaluationSample",
    "Inputs",
    "Normalization",
    "TrainingImages",
    "TrainingSample",
    "collate",
    "normalize",
    "render_inputs",
]

MAX_DEPTH_M = 4.0
"""Depth is clipped to this (released code of the paper)."""

Inputs = Sequence[Tensor]
"""RGB and perhaps depth as they were rendered, see `TrainingSample`."""

_Images = TypeVar("_Images", Inputs, Tensor)
_Sample = TypeVar("_Sample", "TrainingSample[Inputs]", "EvaluationSample[Inputs]")


@dataclass(frozen=True)
class Normalization:
    """Mean and standard deviation of the channels R, G, B (of 0 to 1) and perhaps depth (metres).

    Depth counts clipped to `MAX_DEPTH_M` and 0 where missing. Spheres of shapes have six channels,
    see `mesh_spheres`.

    Attributes:
        mean: 3, 4 or 6 numbers.
        std: As many, greater than 0.

    Raises:
        SettingError: Other numbers.
    """

    mean: Sequence[float]
    std: Sequence[float]

    def __post_init__(self) -> None:
        # Plain tuples, whatever list a config brought: comparable and safe in checkpoints.
        object.__setattr__(self, "mean", tuple(float(value) for value in self.mean))
        object.__setattr__(self, "std", tuple(float(value) for value in self.std))
        right = len(self.mean) == len(self.std) and len(self.mean) in (3, 4, 6)
        if not (right and all(map(math.isfinite, [*self.mean, *self.std])) and min(self.std) > 0):
            raise SettingError(
                "normalization",
                found=f"mean {self.mean}, std {self.std}",
                expected="3 numbers each, 4 with depth, 6 of shapes, std greater than 0",
            )

    @property
    def channels(self) -> int:
        """3, 4 with depth, or 6 of shapes."""
        return len(self.mean)


RGB_NORMALIZATION = Normalization(
    mean=(0.5490, 0.5306, 0.4779),
    std=(0.1992, 0.2005, 0.2129),
)
"""Stanford2D3DS without depth (released code of the paper)."""

RGBD_NORMALIZATION = Normalization(
    mean=(0.4974898, 0.47918808, 0.42809588, 1.0961773),
    std=(0.23762763, 0.23354423, 0.23272438, 0.75536704),
)
"""Stanford2D3DS with depth (ugscnn, used by the released code of the paper)."""


def normalize(inputs: Sequence[Tensor], normalization: Normalization) -> Tensor:
    """What a network takes, channels first.

    Args:
        inputs: RGB ``(..., h, w, 3)`` uint8, and perhaps depth ``(..., h, w)`` in steps of 1/512 m,
            0 where missing, at most `MAX_DEPTH_M`.
        normalization: Of as many channels as there are.

    Returns:
        ``(..., 3 or 4, h, w)`` float32, on the same device.

    Raises:
        SettingError: The normalization is one of other channels.
    """
    rgb, *depth = inputs
    channels = 3 + len(depth)
    if normalization.channels != channels:
        raise SettingError(
            "normalization",
            found=f"{normalization.channels} channels",
            expected=f"{channels}, as the inputs have",
        )
    *batch, height, width, _ = rgb.shape
    images = rgb.new_empty((*batch, channels, height, width), dtype=torch.float32)
    images[..., :3, :, :] = rgb.movedim(-1, -3)
    for steps in depth:
        images[..., 3, :, :] = steps
    # One multiplication and one addition per value: (v / unit − mean) / std.
    unit = [255] * 3 + [STEPS_PER_M] * len(depth)
    scale = zip(unit, normalization.mean, normalization.std, strict=True)
    values = images.new_tensor([(1 / (step * std), mean / std) for step, mean, std in scale])
    factor, offset = values.T[..., None, None]
    return images.mul_(factor).sub_(offset)


class TrainingSample(NamedTuple, Generic[_Images]):
    """One panorama or photo seen through P images; collated, each has a leading batch dimension.

    Attributes:
        images: From the loader what was rendered, RGB ``(P, h, w, 3)`` uint8 and perhaps depth
            ``(P, h, w)`` int16: a third of the bytes. On the device `normalize` makes them
            ``(P, C, h, w)`` float32.
        labels: ``(P, h, w)`` uint8, 0 where unknown.
        index: Place in its split.
    """

    images: _Images
    labels: Tensor
    index: int  # type: ignore[assignment]  # nobody needs tuple.index


class EvaluationSample(NamedTuple, Generic[_Images]):
    """One whole panorama or photo; collated, each has a leading batch dimension.

    Attributes:
        images: N images of all of it, as in `TrainingSample`.
        target: uint8 labels, 0 where unknown: ``(H, W)`` of the panorama itself; ``(N, h, w)`` of
            the crops of a photo.
        index: Place in its split.
    """

    images: _Images
    target: Tensor
    index: int  # type: ignore[assignment]  # nobody needs tuple.index


class TrainingImages(Dataset[TrainingSample[Inputs]]):
    """Random views of images, by (epoch, index).

    Args:
        source: The images.
        representation: What the network sees of them.
        seed: Seed of the run, 0 or more.
        color_jitter: Strength of the colour augmentation, 0 to 1, see `jitter_colors`.
    """

    def __init__(
        self,
        source: ImageSource[LabelledImage],
        representation: Any,
        seed: Seed,
        color_jitter: float = 0.0,
    ) -> None:
        self._source = source
        self._representation = representation
        self._seed = seed
        self._color_jitter = color_jitter

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, key: tuple[int, int]) -> TrainingSample[Inputs]:
        epoch, index = key
        image = self._source.read(index)
        rng = sample_rng(self._seed, epoch, index)
        views = image.sampler(self._representation).sample(rng)
        rgb, *depth = render_inputs(image.rgb, image.depth, views)
        if self._color_jitter:
            rgb = jitter_colors(rgb, self._color_jitter, rng)
        return TrainingSample(
            (rgb, *depth),
            _tensor(views.render(image.labels, "nearest")),
            index,
        )


class EvaluationImages(Dataset[EvaluationSample[Inputs]]):
    """Whole images, by (epoch, index); the epoch changes nothing.

    Args:
        source: The images.
        representation: What the network sees of them.
    """

    def __init__(self, source: ImageSource[LabelledImage], representation: Any) -> None:
        self._source = source
        self._representation = representation

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, key: tuple[int, int]) -> EvaluationSample[Inputs]:
        _, index = key
        image = self._source.read(index)
        views = image.sampler(self._representation).whole()
        images = render_inputs(image.rgb, image.depth, views)
        target = image.target(self._representation)
        return EvaluationSample(images, torch.tensor(target), index)


def collate(samples: list[_Sample]) -> _Sample:
    """A batch of `TrainingSample` or `EvaluationSample`, with a leading dimension.

    As torch's own function, but one sample alone is not copied.
    """
    if len(samples) > 1:
        return default_collate(samples)
    images, labels, index = samples[0]
    kind: Any = type(samples[0])
    return kind([image[None] for image in images], labels[None], torch.tensor([index]))


def render_inputs(
    rgb: NDArray[np.uint8], depth: NDArray[np.uint16] | None, views: Views
) -> tuple[Tensor, ...]:
    """What a network is shown of an image, before `normalize`.

    Args:
        rgb: ``(H, W, 3)``.
        depth: ``(H, W)`` in steps of 1/512 m, 0 where missing; or None.
        views: Where it looks.

    Returns:
        RGB ``(n, h, w, 3)`` uint8 and, with depth, ``(n, h, w)`` int16 steps up to `MAX_DEPTH_M`.
    """
    colors = _tensor(views.render(rgb, "bilinear"))
    if depth is None:
        return (colors,)
    steps = np.minimum(views.render(depth, "nearest"), int(MAX_DEPTH_M * STEPS_PER_M))
    return colors, torch.from_numpy(steps.view(np.int16))  # torch hardly knows uint16


def _tensor(array: NDArray[np.uint8]) -> Tensor:
    # What is rendered may be the panorama itself, shared or a read-only file: that is copied.
    return torch.from_numpy(array) if array.flags.owndata else torch.tensor(array)
