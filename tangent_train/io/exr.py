"""Depth in OpenEXR images, by the OpenEXR package (the extra ``exr``)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import of_extra
from tangent_train.files import atomic_path


def open_exr(path: Path) -> tuple[tuple[int, int], Callable[[bool], NDArray[Any]]]:
    """Read the header of an OpenEXR image.

    Returns:
        Rows and columns; and a function that decodes one channel ``(H, W)`` as float32, float16 or
        uint32. Of several channels, it is the one whose name ends in Z, Y, V or R, in this order of
        preference.

    Raises:
        SettingError: The OpenEXR package is missing.
    """
    with of_extra("exr", path, "Or convert the file to a float TIFF."):
        import OpenEXR
    with OpenEXR.File(str(path), header_only=True) as header:
        (left, top), (right, bottom) = (c.tolist() for c in header.header()["dataWindow"])
    size = bottom - top + 1, right - left + 1

    def decode(indices: bool) -> NDArray[Any]:
        del indices
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            name = _depth_channel(list(channels))
            pixels: NDArray[Any] = channels[name].pixels if name else np.empty(())
            if len(file.parts) != 1 or pixels.shape != size or pixels.dtype == object:
                raise ValueError(
                    f"{len(file.parts)} parts, channels {', '.join(channels)}; one part and one "
                    "depth per pixel, in a single channel or one called Z, Y, V or R"
                )
        return pixels

    return size, decode


def _depth_channel(names: list[str]) -> str:
    """Return the name of the channel of depth, empty without one."""
    # Renderers put the name of a layer first: "ViewLayer.Depth.Z".
    of_letters = ([name for name in names if name.rsplit(".", 1)[-1] == end] for end in "ZYVR")
    return next((found[0] for found in (names, *of_letters) if len(found) == 1), "")


def write_exr(path: Path, pixels: NDArray[Any]) -> None:
    """Write ``(H, W)`` float32 pixels as channel Z, atomically.

    Raises:
        SettingError: The OpenEXR package is missing.
    """
    with of_extra("exr", path):
        import OpenEXR
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_path(path) as temporary:
        OpenEXR.File(header, {"Z": np.ascontiguousarray(pixels)}).write(str(temporary))
