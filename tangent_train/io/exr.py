"""Depth in OpenEXR images, by the OpenEXR package (the extra ``exr``)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import DataError, of_extra
from tangent_train.files import atomic_path
from tangent_train.io.png import check_pixels

_PREFERRED = ("Z", "Y", "V", "R")
_CONVERT = "Save the depth alone, or convert it to a float TIFF or .npy file."


def read_exr_size(path: Path) -> tuple[int, int]:
    """Read rows and columns of an OpenEXR image, from its header.

    Raises:
        DataError: It cannot be read.
        SettingError: The OpenEXR package is missing.
    """
    with _opened(path, header_only=True) as file:
        (left, top), (right, bottom) = (corner.tolist() for corner in file.header()["dataWindow"])
    height, width = bottom - top + 1, right - left + 1
    check_pixels(path, height, width)
    return height, width


def read_exr(path: Path) -> NDArray[Any]:
    """Decode one channel of an OpenEXR image.

    Args:
        path: File. Of several channels, the one whose name ends in Z, Y, V or R is read, in this
            order of preference.

    Returns:
        ``(H, W)`` float32, float16 or uint32, as stored.

    Raises:
        DataError: The file cannot be read, has several parts or depths per pixel, or lacks such a
            channel.
        SettingError: The OpenEXR package is missing.
    """
    size = read_exr_size(path)
    with _opened(path, header_only=False) as file:
        if len(file.parts) != 1:
            raise _refused(path, f"{len(file.parts)} parts that can be decoded", "one")
        channels = file.channels()
        pixels: NDArray[Any] = channels[_depth_channel(path, list(channels))].pixels
    if pixels.shape != size or pixels.dtype == object:
        raise _refused(path, "subsampled or deep pixels", "one depth per pixel")
    return pixels


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


@contextmanager
def _opened(path: Path, *, header_only: bool) -> Iterator[Any]:
    with of_extra("exr", path, "Or convert the file to a float TIFF."):
        import OpenEXR
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=header_only) as file:
            yield file
    except DataError:
        raise
    except (RuntimeError, ValueError, KeyError, MemoryError) as error:
        raise _refused(path, error, "an OpenEXR image") from error


def _refused(path: Path, found: object, expected: str) -> DataError:
    return DataError(path, found=found, expected=expected, remedy=_CONVERT)


def _depth_channel(path: Path, names: list[str]) -> str:
    if len(names) == 1:
        return names[0]
    for letter in _PREFERRED:
        # Renderers put the name of a layer first: "ViewLayer.Depth.Z".
        chosen = [name for name in names if name.rsplit(".", 1)[-1] == letter]
        if len(chosen) == 1:
            return chosen[0]
    raise _refused(path, f"channels {', '.join(names)}", "one channel, or one called Z, Y, V or R")
