"""Depth of OpenEXR images, as cameras of renderers write them, through OpenEXR's own package.

The package is optional: OpenCV's wheels are made without OpenEXR, and few data sets have it.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from datamodules.images.image_opening import check_pixels
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["read_exr", "read_exr_size"]

_MAGIC = b"\x76\x2f\x31\x01"
_PREFERRED = ("Z", "Y", "V", "R")
_EXPECTED = "an OpenEXR image"
_CONVERT = "convert it to a float TIFF or .npy file"


@dataclass(frozen=True)
class _Header:
    """What the header says.

    Attributes:
        shape: Rows and columns.
        channels: Of each, every how many columns and rows it has a pixel.
    """

    shape: tuple[int, int]
    channels: dict[str, tuple[int, int]]


def read_exr_size(path: Path) -> tuple[int, int]:
    """Rows and columns of an OpenEXR image, from its header.

    Raises:
        DataError: It cannot be read, is no plain image, or the package OpenEXR is missing.
    """
    return _read_header(path).shape


def read_exr(path: Path) -> NDArray[Any]:
    """Decode one channel of an OpenEXR image, of scan lines or tiles in any compression.

    Args:
        path: The file. Of several channels the one whose name ends in Z, Y, V or R, the earlier of
            these letters first. The others are decoded too, and need memory for as long.

    Returns:
        ``(H, W)`` of the type of the file: float32, float16 or uint32.

    Raises:
        DataError: It cannot be read, is broken, has several parts, several depths per pixel or no
            such channel, or the package OpenEXR is missing.
    """
    header = _read_header(path)
    name = _choose_channel(path, list(header.channels))
    if header.channels[name] != (1, 1):
        columns, rows = header.channels[name]
        raise DataError(
            path,
            found=f"channel {name} with one pixel per {rows} rows and {columns} columns",
            expected="one per row and column",
            remedy="Save the depth alone.",
        )
    with _opened(path, header_only=False) as file:
        if not file.parts:  # the package leaves out what it cannot decode
            raise _broken(path, "pixels that cannot be decoded")
        pixels: NDArray[Any] = file.channels()[name].pixels
    return pixels


def _read_header(path: Path) -> _Header:
    with _opened(path, header_only=True) as file:
        parts, header = len(file.parts), file.header()
        (left, top), (right, bottom) = (corner.tolist() for corner in header["dataWindow"])
        channels = {
            channel.name: (channel.xSampling, channel.ySampling) for channel in header["channels"]
        }
        kind = header["type"].name
    if parts > 1:
        raise DataError(
            path,
            found=f"{parts} parts",
            expected="an OpenEXR image of one",
            remedy=f"Save the depth alone, or {_CONVERT}.",
        )
    if kind.startswith("deep"):
        raise DataError(
            path,
            found="deep pixels, of several depths each",
            expected="one depth per pixel",
            remedy="Flatten the image.",
        )
    height, width = bottom - top + 1, right - left + 1
    if not height * width > 0:
        raise DataError(path, found=f"{height}×{width} pixels", expected="some")
    check_pixels(path, height, width)
    return _Header((height, width), channels)


@contextmanager
def _opened(path: Path, *, header_only: bool) -> Iterator[Any]:
    """The file as the package OpenEXR gives it, of which every error is explained."""
    _check_start(path)
    try:
        import OpenEXR
    except ImportError as error:
        raise DataError(
            path,
            found="an OpenEXR file",
            expected="the package OpenEXR, to read it",
            remedy=f"Run: pip install 'tangent-train[exr]', or {_CONVERT}.",
        ) from error
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=header_only) as file:
            yield file
    except DataError:
        raise
    except (RuntimeError, ValueError, KeyError, MemoryError) as error:
        raise _broken(path, error) from error


def _check_start(path: Path) -> None:
    """Explain what the package would only tell on the screen."""
    try:
        with path.open("rb") as file:
            start = file.read(len(_MAGIC))
    except OSError as error:
        raise DataError(path, found=error, expected=_EXPECTED) from error
    if start != _MAGIC:
        raise _broken(path, "a file of another kind, or an empty one")


def _broken(path: Path, found: object) -> DataError:
    return DataError(path, found=found, expected=_EXPECTED, remedy=f"Save it again, or {_CONVERT}.")


def _choose_channel(path: Path, names: list[str]) -> str:
    if len(names) == 1:
        return names[0]
    for letter in _PREFERRED:
        # Renderers put the name of a layer first: "ViewLayer.Depth.Z".
        chosen = [name for name in names if name.rsplit(".", 1)[-1] == letter]
        if len(chosen) == 1:
            return chosen[0]
    raise DataError(
        path,
        found=f"channels {', '.join(names)}",
        expected="one channel, or just one called Z, Y, V or R",
        remedy="Save the depth alone.",
    )
