"""From panoramas to what a network is trained and evaluated on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from datamodules.sampling import sample_rng
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from datamodules.panoramas import Panorama, PanoramaSource
    from tangent_train.rendering.representation import Representation, Views

__all__ = [
    "RGBD_NORMALIZATION",
    "RGB_NORMALIZATION",
    "EvaluationPanoramas",
    "EvaluationSample",
    "Normalization",
    "TrainingPanoramas",
    "TrainingSample",
    "normalize",
]

MAX_DEPTH_M = 4.0
"""Depth is clipped to this (released code of the paper)."""


@dataclass(frozen=True)
class Normalization:
    """Mean and standard deviation of the channels R, G, B (of 0 to 1) and perhaps depth (metres).

    Depth counts clipped to `MAX_DEPTH_M` and 0 where missing.

    Attributes:
        mean: 3 or 4 numbers.
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
        right = len(self.mean) == len(self.std) and len(self.mean) in (3, 4)
        if not (right and all(map(math.isfinite, [*self.mean, *self.std])) and min(self.std) > 0):
            raise SettingError(
                "normalization",
                found=f"mean {self.mean}, std {self.std}",
                expected="3 numbers each, 4 with depth, std greater than 0",
            )

    @property
    def channels(self) -> int:
        """3, or 4 with depth."""
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


def normalize(
    rgb: NDArray[np.uint8], depth_m: NDArray[np.float32] | None, normalization: Normalization
) -> NDArray[np.float32]:
    """What a network takes, channels first.

    Args:
        rgb: ``(n, h, w, 3)`` uint8.
        depth_m: ``(n, h, w)`` metres, 0 where missing; None for a normalization without depth.
        normalization: Of as many channels as there are.

    Returns:
        ``(n, 3 or 4, h, w)`` float32.

    Raises:
        SettingError: The normalization is one of other channels.
    """
    channels = 3 if depth_m is None else 4
    if normalization.channels != channels:
        raise SettingError(
            "normalization",
            found=f"{normalization.channels} channels",
            expected=f"{channels}, as the inputs have",
        )
    images = np.empty((len(rgb), channels, *rgb.shape[1:3]), np.float32)
    for channel in range(3):
        images[:, channel] = rgb[..., channel]
    # One multiplication and one addition per value: (v / unit − mean) / std.
    unit = np.full(channels, 255.0)
    if depth_m is not None:
        np.clip(depth_m, 0, MAX_DEPTH_M, out=images[:, 3])
        unit[3] = 1.0
    mean, std = np.array(normalization.mean), np.array(normalization.std)
    images *= (1 / (unit * std)).astype(np.float32)[:, None, None]
    images -= (mean / std).astype(np.float32)[:, None, None]
    return images


class TrainingSample(NamedTuple):
    """One panorama seen through P images; collated, each has a leading batch dimension.

    Attributes:
        images: ``(P, C, h, w)`` float32.
        labels: ``(P, h, w)`` uint8, 0 where unknown.
        index: Place of the panorama in its split.
    """

    images: Tensor
    labels: Tensor
    index: int  # type: ignore[assignment]  # nobody needs tuple.index


class EvaluationSample(NamedTuple):
    """One whole panorama; collated, each has a leading batch dimension.

    Attributes:
        images: ``(N, C, h, w)`` float32, all of the sphere.
        target: ``(H, W)`` uint8 labels of the panorama itself, 0 where unknown.
        index: Place of the panorama in its split.
    """

    images: Tensor
    target: Tensor
    index: int  # type: ignore[assignment]  # nobody needs tuple.index


class TrainingPanoramas(Dataset[TrainingSample]):
    """Random views of panoramas, by (epoch, index).

    Args:
        source: The panoramas.
        representation: What the network sees of them.
        normalization: Of the channels the source has.
        seed: Seed of the run, 0 or more.
    """

    def __init__(
        self,
        source: PanoramaSource,
        representation: Representation,
        normalization: Normalization,
        seed: int,
    ) -> None:
        self._source = source
        self._representation = representation
        self._normalization = normalization
        self._seed = seed

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, key: tuple[int, int]) -> TrainingSample:
        epoch, index = key
        panorama = self._source.read(index)
        views = self._representation.sample(sample_rng(self._seed, epoch, index))
        return TrainingSample(
            _render_images(panorama, views, self._normalization),
            torch.from_numpy(views.render(panorama.labels, "nearest")),
            index,
        )


class EvaluationPanoramas(Dataset[EvaluationSample]):
    """Whole panoramas, by (epoch, index); the epoch changes nothing.

    Args:
        source: The panoramas.
        representation: What the network sees of them.
        normalization: Of the channels the source has.
    """

    def __init__(
        self, source: PanoramaSource, representation: Representation, normalization: Normalization
    ) -> None:
        self._source = source
        self._representation = representation
        self._normalization = normalization

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, key: tuple[int, int]) -> EvaluationSample:
        _, index = key
        panorama = self._source.read(index)
        images = _render_images(panorama, self._representation.whole(), self._normalization)
        return EvaluationSample(images, torch.from_numpy(panorama.labels), index)


def _render_images(panorama: Panorama, views: Views, normalization: Normalization) -> Tensor:
    rgb = views.render(panorama.rgb, "bilinear")
    depth_m = None if panorama.depth_m is None else views.render(panorama.depth_m, "nearest")
    return torch.from_numpy(normalize(rgb, depth_m, normalization))
