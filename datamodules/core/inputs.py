"""Network inputs: their channels and normalization."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from datamodules.core.images import STEPS_PER_M
from tangent_train.errors import SettingError

Input = Literal["rgb", "depth", "elevation"]
"""Inputs of a network, in channel order, see `channel_names`.

* `rgb` and `depth` are normalized.
* `elevation`: the sine of the angle between a pixel's ray and the horizon, −1 (down) to 1 (up).
"""

INPUTS: tuple[Input, ...] = get_args(Input)
"""All inputs, in channel order."""

_COLORS = ("red", "green", "blue")

_BYTE = 255

_SHAPES = 6
"""Channels of spheres of shapes, which are not colors."""

MAX_DEPTH_M = 4.0
"""Maximum depth in meters; larger depth is clipped (released code of the paper)."""


@dataclass(frozen=True)
class Normalization:
    """Mean and standard deviation of the channels R, G, B (of 0 to 1) and perhaps depth (meters).

    Depth is clipped to `MAX_DEPTH_M` and is 0 where missing. Spheres of shapes have six channels,
    see `mesh_spheres`.

    Attributes:
        mean: 3, 4 or 6 numbers.
        std: As many numbers, greater than 0.

    Raises:
        SettingError: The counts differ, or a number is out of range.
    """

    mean: Sequence[float]
    std: Sequence[float]

    def __post_init__(self) -> None:
        # Plain tuples, whatever list a config brought: comparable and safe in checkpoints.
        mean: tuple[float, ...] = ()
        std: tuple[float, ...] = ()
        with suppress(TypeError, ValueError):
            mean, std = (tuple(map(float, values)) for values in (self.mean, self.std))
        right = len(mean) == len(std) and len(mean) in (3, 4, 6)
        if not (right and all(map(math.isfinite, mean + std)) and min(std) > 0):
            raise SettingError(
                "normalization",
                found=f"mean {self.mean}, std {self.std}",
                expected="3 numbers each, as mean: [0.5, 0.5, 0.5], 4 with depth, 6 of shapes, std "
                "greater than 0",
            )
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "std", std)

    @classmethod
    def of(cls, given: Any, channels: int, setting: str = "normalization") -> Self:
        """Return the normalization that a setting names or describes.

        Args:
            given: ``imagenet``, ``unit`` (0 to 1) or ``symmetric`` (-1 to 1) of RGB, a mapping with
                ``mean`` and ``std``, or the normalization itself.
            channels: Required number of channels.
            setting: Name of the setting, for error messages.

        Raises:
            SettingError: It is not a normalization, has other channels, or is meant for 0 to 255.
        """
        if isinstance(given, str):
            given = _NAMED.get(given, given)
        if isinstance(given, Mapping) and set(given) == {"mean", "std"}:
            given = cls(given["mean"], given["std"])
            if given.channels < _SHAPES:
                _check_colors(given, setting)
        if not isinstance(given, cls):
            raise SettingError(
                setting,
                found="none" if given is None else given,
                expected=f"{', '.join(_NAMED)}, or {{mean: […], std: […]}} of 0 to 1",
                remedy="Take what the network was trained with; labels are poor with another one.",
            )
        if given.channels != channels:
            raise SettingError(
                setting,
                found=f"{given.channels} channels",
                expected=f"{channels}, as the inputs have",
            )
        return given

    @property
    def channels(self) -> int:
        """3, 4 with depth, or 6 of shapes."""
        return len(self.mean)


def _check_colors(given: Normalization, setting: str) -> None:
    """Refuse RGB numbers that are not meant for images from 0 to 1."""
    mean, std = given.mean[:3], given.std[:3]
    if min(mean) >= 0 and max(*mean, *std) <= 1:
        return
    numbers = [[float(f"{value / _BYTE:.4g}") for value in values] for values in (mean, std)]
    raise SettingError(
        setting,
        found=f"mean {mean}, std {std} of red, green and blue",
        expected="numbers from 0 to 1, for images from 0 to 1",
        remedy="If they are of images from 0 to 255, divide all by 255: mean {}, std {}.".format(
            *numbers
        ),
    )


_NAMED = {
    "imagenet": Normalization((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "unit": Normalization((0, 0, 0), (1, 1, 1)),
    "symmetric": Normalization((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
}
"""Named normalizations of RGB from 0 to 1: torchvision's, none, and to -1 … 1."""

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


def channel_names(inputs: Sequence[Input]) -> tuple[str, ...]:
    """Return the channel names of inputs; `rgb` gives three.

    >>> channel_names(["rgb", "depth"])
    ('red', 'green', 'blue', 'depth')
    """
    return tuple(name for each in inputs for name in (_COLORS if each == "rgb" else (each,)))


def ordered_inputs(inputs: Sequence[Input]) -> tuple[Input, ...]:
    """Return the names of inputs in the order of their channels.

    Raises:
        SettingError: An unknown name, or `rgb` is missing.
    """
    ordered = tuple(name for name in INPUTS if name in inputs)
    known = not isinstance(inputs, str) and sorted(ordered) == sorted(inputs)
    if not known or "rgb" not in inputs:
        raise SettingError(
            "data.inputs",
            found=inputs if isinstance(inputs, str) else list(inputs),
            expected="a list: rgb, perhaps depth and elevation",
        )
    return ordered


def normalize(
    rendered: Sequence[Tensor], normalization: Normalization, inputs: Sequence[Input]
) -> Tensor:
    """Normalize to a network's input, channels first.

    Args:
        rendered: RGB ``(..., h, w, 3)`` uint8; with depth ``(..., h, w)`` in steps of 1/512 m, 0
            where missing, at most `MAX_DEPTH_M`; with elevation ``(..., h, w)`` float32.
        normalization: Normalization of RGB and depth.
        inputs: Inputs of the network, in the order of `INPUTS`.

    Returns:
        ``(..., C, h, w)`` float32, on the same device.

    Raises:
        SettingError: The normalization has other channels.
    """
    parts = dict(zip([name for name in INPUTS if name in inputs], rendered, strict=True))
    measured = 3 + ("depth" in parts)
    rgb = parts["rgb"]
    *batch, height, width, _ = rgb.shape
    channels = len(channel_names(inputs))
    images = rgb.new_empty((*batch, channels, height, width), dtype=torch.float32)
    images[..., :3, :, :] = rgb.movedim(-1, -3)
    if "depth" in parts:
        images[..., 3, :, :] = parts["depth"]
    units = [255] * 3 + [STEPS_PER_M] * (measured - 3)
    normalize_channels(images[..., :measured, :, :], units, normalization)
    if "elevation" in inputs:
        images[..., -1, :, :] = parts["elevation"]
    return images


def normalize_channels(
    images: Tensor, units: Sequence[float], normalization: Normalization
) -> Tensor:
    """Normalize stored values in place, ``(v / unit − mean) / std``.

    Args:
        images: ``(..., C, h, w)`` float32.
        units: Stored value that stands for 1, for each channel.
        normalization: Normalization of C channels.

    Returns:
        The images.
    """
    # One multiplication and one addition per value.
    scale = zip(units, normalization.mean, normalization.std, strict=True)
    values = [value for unit, mean, std in scale for value in (1 / (unit * std), mean / std)]
    # Filled in on the device: a copy from the host would wait for all queued GPU work.
    filled = torch.stack([images.new_full((), value) for value in values])
    factor, offset = filled.view(-1, 2).T[..., None, None]
    return images.mul_(factor).sub_(offset)
