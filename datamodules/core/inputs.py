"""Network inputs: their channels and normalization."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from datamodules.core.depth import STEPS_PER_M
from tangent_train.errors import SettingError

Input = Literal["rgb", "depth", "elevation"]
"""Inputs of a network, in channel order, see `channel_names`.

* `rgb` and `depth` are normalized.
* `elevation`: the sine of the angle between a pixel's ray and the horizon, −1 (down) to 1 (up).
"""

INPUTS: tuple[Input, ...] = get_args(Input)
"""All inputs, in channel order."""

_COLORS = ("red", "green", "blue")

MAX_DEPTH_M = 4.0
"""Maximum depth in meters; larger depth is clipped (released code of the paper)."""

_SHAPES = 6
"""Channels of spheres of shapes, which are not colors."""


@dataclass(frozen=True)
class Normalization:
    """Mean and standard deviation of the channels R, G, B (of 0 to 1) and perhaps depth (meters).

    Depth is clipped to `MAX_DEPTH_M` and is 0 where missing. Spheres of shapes have six channels,
    see `mesh_spheres`.

    Attributes:
        mean: 3, 4 or 6 numbers.
        std: As many numbers, greater than 0.
    """

    mean: Sequence[float]
    std: Sequence[float]

    def __post_init__(self) -> None:
        # Plain tuples, whatever list a config brought: comparable and safe in checkpoints.
        object.__setattr__(self, "mean", tuple(map(float, self.mean)))
        object.__setattr__(self, "std", tuple(map(float, self.std)))

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
        if not (isinstance(given, cls) and given._suits(channels)):
            raise SettingError(
                setting,
                found="none" if given is None else given,
                expected=f"{', '.join(_NAMED)}, or {{mean: […], std: […]}} with {channels} numbers "
                "each, of images from 0 to 1",
                remedy="Take what the network was trained with; divide numbers of images from 0 to "
                "255 by 255.",
            )
        return given

    def _suits(self, channels: int) -> bool:
        largest = 1 if channels < _SHAPES else float("inf")
        return (
            len(self.mean) == len(self.std) == channels
            and min(self.std) > 0
            and max(*self.mean[:3], *self.std[:3]) <= largest
        )

    @property
    def channels(self) -> int:
        """3, 4 with depth, or 6 of shapes."""
        return len(self.mean)


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

    """
    rgb, *others = rendered
    images = rgb.movedim(-1, -3).to(torch.float32, memory_format=torch.contiguous_format)
    if others:
        images = torch.cat([images, *(other.unsqueeze(-3) for other in others)], dim=-3)
    units = [255] * 3 + [STEPS_PER_M] * ("depth" in inputs)
    normalize_channels(images[..., : len(units), :, :], units, normalization)
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
