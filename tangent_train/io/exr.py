"""Depth and colors in OpenEXR images, by the OpenEXR package (the extra ``exr``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, listed, of_extra
from tangent_train.files import atomic_path

_MOST_NAMED = 100
"""Largest number of channels that a message names."""


def open_exr(
    path: Path, channel: str | None = None
) -> tuple[tuple[int, int], Callable[[bool], NDArray[Any]]]:
    """Read the header of an OpenEXR image.

    Args:
        path: The file, of one part whose data window is the display window.
        channel: Name of the channel to decode; None for depth or colors.

    Returns:
        Rows and columns; and a function that decodes the pixels: given True, the channel of depth,
        ``(H, W)`` as float32, float16 or uint32; given False, the colors, ``(H, W, 3)`` as float32,
        or depth if there are no colors.

    Raises:
        SettingError: The OpenEXR package is missing.
    """
    with of_extra("exr", path, "Or convert the file to a float TIFF."):
        import OpenEXR
    with OpenEXR.File(str(path), header_only=True) as file:
        headers = [dict(part.header) for part in file.parts]  # cleared when the file is closed
    windows = {str(of[name]) for of in headers for name in ("dataWindow", "displayWindow")}
    if len(headers) != 1 or len(windows) != 1:
        raise ValueError("several parts, or a data window beside the display window")
    first, last = (np.asarray(corner, np.int64)[::-1] for corner in headers[0]["dataWindow"])
    size, known = tuple((last - first + 1).tolist()), [one.name for one in headers[0]["channels"]]

    def decode(indices: bool) -> NDArray[Any]:
        names = _chosen_names(path, known, channel, indices=indices)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.parts[0].channels
            decoded: list[NDArray[Any]] = [channels[name].pixels.copy() for name in names]
        if any(pixels.dtype == object or pixels.shape != size for pixels in decoded):
            raise ValueError("several samples per pixel, or subsampled")
        return decoded[0] if len(decoded) == 1 else np.stack(decoded, -1).astype(np.float32)

    return (size[0], size[1]), decode


def _chosen_names(
    path: Path, names: Sequence[str], channel: str | None, *, indices: bool
) -> list[str]:
    """Return the name of the channel of depth, or the names of red, green and blue.

    Raises:
        DataError: There is not exactly one such channel or layer.
    """
    layers: dict[str, dict[str, str]] = {}
    for name in names:
        layer, _, last = name.rpartition(".")
        layers.setdefault(layer, {})[last.upper()] = name
    colors = [[of[c] for c in "RGB"] for of in layers.values() if of.keys() >= {*"RGB"}]
    blender = [one for one in colors if one[0].endswith("Combined.R")]
    colors = [one for one in colors if "." not in one[0]] or blender or colors
    depth = [[name] for name in names if _is_depth(name, names)]
    choices, expected = depth, "one channel of depth: Z, depth, depth.Z or depth.V in any layer"
    if channel is not None:
        choices, expected = [[name] for name in names if name == channel], f"channel {channel}"
    elif colors and not indices:
        choices, expected = colors, "one layer with the channels R, G and B"
    if len(choices) != 1:
        known = listed(names, _MOST_NAMED)
        raise DataError(
            path,
            found="; ".join(", ".join(one) for one in choices) or "none",
            expected=expected,
            remedy=f"Name one with depth_channel=, for training data data.depth_channel=: {known}",
        )
    return choices[0]


def _is_depth(name: str, names: Sequence[str]) -> bool:
    """Return True for a channel called depth, or Z or V in a layer called depth.

    Z is also depth without a layer or in a layer with colors, but not beside X: others are parts of
    vectors, or passes such as mist. A single Y is depth, which OpenCV writes, or distance.
    """
    *layers, last = name.lower().split(".")
    if last == "depth" or (layers[-1:] == ["depth"] and last in ("z", "v")):
        return True
    layer = "".join(f"{one}." for one in layers)
    beside = {n.lower().removeprefix(layer) for n in names if n.lower().startswith(layer)}
    has_colors = any(one.rpartition(".")[2] == "r" for one in beside)
    is_z = last == "z" and "x" not in beside and (not layer or has_colors)
    return is_z or (last in ("y", "distance") and len(names) == 1 and not layer)


def write_exr(path: Path, pixels: NDArray[Any]) -> None:
    """Write float32 pixels atomically.

    Args:
        path: The file.
        pixels: ``(H, W)``, as channel Z; or ``(H, W, 3)``, as channels R, G and B.

    Raises:
        SettingError: The OpenEXR package is missing.
    """
    with of_extra("exr", path):
        import OpenEXR
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        channels = {"Z" if pixels.ndim == 2 else "RGB": np.ascontiguousarray(pixels)}
        OpenEXR.File(header, channels).write(str(temporary))
