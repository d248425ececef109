"""Images and arrays of any kind of number, read and written as they are: 8 and 16 bits, floats."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from PIL.TiffImagePlugin import ImageFileDirectory_v2

from datamodules.images.exr import read_exr
from datamodules.images.image_files import read_array, read_rgb
from datamodules.images.image_opening import check_pixels, open_image, oriented_array
from datamodules.images.png import decoded
from tangent_train.errors import DataError, SettingError
from tangent_train.files import atomic_path, write_bytes

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import DTypeLike, NDArray

__all__ = [
    "LOSSY_SUFFIXES",
    "PIXEL_SUFFIXES",
    "READABLE_SUFFIXES",
    "check_writable",
    "read_pixels",
    "write_pixels",
]

_EIGHT = (np.dtype(np.uint8),)
_SIXTEEN = (*_EIGHT, np.dtype(np.uint16))
_WRITABLE = {
    ".png": _SIXTEEN,
    ".jpg": _EIGHT,
    ".jpeg": _EIGHT,
    ".webp": _EIGHT,
    ".tif": (*_SIXTEEN, np.dtype(np.float32)),
    ".tiff": (*_SIXTEEN, np.dtype(np.float32)),
}
"""Types of numbers that images hold, by what their names end in; ``.npy`` holds any."""

PIXEL_SUFFIXES = (*_WRITABLE, ".npy")
"""What names of files of pixels end in, in lower case."""

READABLE_SUFFIXES = (*PIXEL_SUFFIXES, ".exr")
"""What names of files end in that `read_pixels` takes."""

LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
"""Files whose pixels come back a little other: not for labels and depth."""

_PNG, _PNG_BITS, _PNG_COLOR = b"\x89PNG\r\n\x1a\n", 24, 25
_GREY_WITH_ALPHA = 4
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_BIG = (b"+\0", b"\0+")
_COLUMNS, _ROWS = 256, 257  # tags of TIFF
_GREY_MODES = ("1", "L", "LA")


def read_pixels(path: Path, *, indices: bool) -> NDArray[Any]:
    """Read an image or an array as it is; only transparency is left out.

    Args:
        path: JPEG, PNG, TIFF, WebP, OpenEXR (one channel of it) or ``.npy``.
        indices: Of an image with a palette, whether to give the indices, not the colours.

    Returns:
        ``(H, W)`` where there is one channel, else ``(H, W, C)``, colours in RGB order. An array is
        mapped from its file and must not be written to.

    Raises:
        DataError: The file cannot be read or is broken, or its array is no image.
    """
    if path.suffix.lower() == ".npy":
        return _read_array(path)
    if path.suffix.lower() == ".exr":
        return read_exr(path)
    try:
        with path.open("rb") as file:
            start = file.read(_PNG_COLOR + 1)
    except OSError as error:
        raise DataError(path, found=error, expected="an image or a .npy file") from error
    is_png = start.startswith(_PNG) and len(start) > _PNG_COLOR
    if start.startswith(_TIFF) or (is_png and start[_PNG_BITS] == 16):
        deep = _read_deep(path, grey=is_png and start[_PNG_COLOR] == _GREY_WITH_ALPHA)
        if deep is not None:
            return deep
    with open_image(path) as image:
        if image.mode in _GREY_MODES or (image.mode == "P" and indices):
            band = np.asarray(image if image.mode != "LA" else image.getchannel(0), np.uint8)
            return np.ascontiguousarray(oriented_array(band, image))
    return read_rgb(path)


def _read_array(path: Path) -> NDArray[Any]:
    array = read_array(path, mapped=True)
    if array.ndim not in (2, 3) or 0 in array.shape or array.dtype.kind not in "buif":
        raise DataError(
            path,
            found=f"{array.dtype} of shape {array.shape}",
            expected="numbers of shape (H, W) or (H, W, C)",
        )
    return array


def _read_deep(path: Path, *, grey: bool) -> NDArray[Any] | None:
    """Pixels of more than 8 bits, which Pillow would cut to 8; None if they have only 8."""
    size = _size(path)
    if size is None:
        return None  # Pillow will say what is wrong
    check_pixels(path, *size)
    image = decoded(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.dtype == np.uint8:
        return None
    if image.ndim == 2 or grey:
        return np.ascontiguousarray(image if image.ndim == 2 else image[..., 0])
    return np.ascontiguousarray(image[..., 2::-1] if image.shape[2] in (3, 4) else image)


def _size(path: Path) -> tuple[int, int] | None:
    """Rows and columns by the header of a PNG or TIFF file, whose pixels Pillow may not know."""
    with path.open("rb") as file:
        head = file.read(_PNG_BITS)
        if head.startswith(_PNG):
            return int.from_bytes(head[20:24], "big"), int.from_bytes(head[16:20], "big")
        try:
            directory = ImageFileDirectory_v2(head[: 16 if head[2:4] in _BIG else 8])
            file.seek(directory.next)
            directory.load(file)
            return int(directory[_ROWS]), int(directory[_COLUMNS])
        except Exception:  # its reader raises many kinds of errors
            return None


def check_writable(suffix: str, dtype: DTypeLike, channels: int) -> None:
    """Refuse what a file of this kind cannot hold as it is.

    Args:
        suffix: What the name ends in, in lower case, with the dot.
        dtype: Of the pixels.
        channels: Of the pixels.

    Raises:
        SettingError: The suffix is unknown, or such a file cannot hold such pixels.
    """
    if suffix not in PIXEL_SUFFIXES:
        raise SettingError(
            "file name", found=f"'{suffix}' at its end", expected=" or ".join(PIXEL_SUFFIXES)
        )
    able = [
        name
        for name in PIXEL_SUFFIXES
        if name == ".npy" or (np.dtype(dtype) in _WRITABLE[name] and channels in (1, 3))
    ]
    if suffix not in able:
        raise SettingError(
            f"{suffix} files",
            found=f"{np.dtype(dtype)} pixels of {channels} channel{'s' if channels > 1 else ''}",
            expected=f"one that can hold them: {' or '.join(able)}",
        )


def write_pixels(path: Path, pixels: NDArray[Any]) -> None:
    """Write pixels as they are, atomically.

    Args:
        path: The file; its name says the format.
        pixels: ``(H, W)`` or ``(H, W, C)``, colours in RGB order.

    Raises:
        SettingError: Such a file cannot hold them.
    """
    suffix = path.suffix.lower()
    check_writable(suffix, pixels.dtype, 1 if pixels.ndim == 2 else pixels.shape[2])
    if suffix == ".npy":
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.save(file, pixels, allow_pickle=False)
        return
    ordered = np.ascontiguousarray(pixels if pixels.ndim == 2 else pixels[..., ::-1])
    try:
        done, encoded = cv2.imencode(suffix, ordered)
    except cv2.error:
        done, encoded = False, ordered
    if not done:
        raise SettingError(
            path.name,
            found=f"{pixels.shape[0]}×{pixels.shape[1]} pixels",
            expected=f"sides that {suffix} files can have",
        )
    write_bytes(path, encoded.tobytes())
