"""Reading and writing images: colours, depth, labels, arrays.

Pillow opens and identifies every image; OpenCV writes, and decodes the 16-bit colours that Pillow
would cut to 8 bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import DTypeLike, NDArray
from PIL import ExifTags, Image, ImageOps

from datamodules.images.exr import read_exr, read_exr_size
from datamodules.images.image_files import IMAGE_FORMATS
from datamodules.images.png import MOST_PIXELS, check_pixels, read_png_header
from tangent_train.errors import DataError, SettingError
from tangent_train.files import atomic_path, reserve, write_bytes

_WRITABLE = {
    ".png": ("uint8", "uint16"),
    ".jpg": ("uint8",),
    ".jpeg": ("uint8",),
    ".webp": ("uint8",),
    ".tif": ("uint8", "uint16", "float32"),
    ".tiff": ("uint8", "uint16", "float32"),
}
"""Pixel types by suffix; ``.npy`` holds any."""

PIXEL_SUFFIXES = (*_WRITABLE, ".npy")
"""Suffixes that `write_pixels` takes, in lower case."""

READABLE_SUFFIXES = (*PIXEL_SUFFIXES, ".exr")
"""Suffixes that `read_pixels` takes."""

LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
"""Formats that change pixels a little: not for labels and depth."""

_SINGLE_CHANNEL = ("L", "I", "F", "I;16", "I;16L", "I;16B", "I;16N")
_MOST_M = 1e4  # depth beyond it marks missing: some files have 1e10 there
_MISSING_UNITS = 65535
_FILM_DIAGONAL_MM = math.hypot(36, 24)

Image.MAX_IMAGE_PIXELS = MOST_PIXELS


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """An image whose size is allowed, not decoded yet; errors in the block name the file."""
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            check_pixels(path, image.height, image.width)
            if image.format == "PNG":
                read_png_header(path)
            yield image
    except (DataError, MemoryError):
        raise
    # Decoders of broken files raise anything, from OSError to SyntaxError and IndexError.
    except Exception as error:
        raise DataError(
            path,
            found=f"no image that can be decoded ({getattr(error, 'strerror', None) or error})",
            expected=f"a whole image of a known format ({', '.join(IMAGE_FORMATS)})",
            remedy="Copy or export the file again, for example as JPEG or PNG.",
        ) from error


def _exif(image: Image.Image) -> Image.Exif:
    """EXIF data; none where they are broken, or behind the pixels of a PNG file."""
    if image.format == "PNG" and "exif" not in image.info:
        return Image.Exif()  # Pillow would decode the pixels to look for them
    try:
        return image.getexif()
    except Exception:  # the parser raises many kinds of errors
        return Image.Exif()


def read_image_size(path: Path) -> tuple[int, int]:
    """Rows and columns that `read_pixels` gives, from the header of the file.

    Raises:
        DataError: It cannot be read, or is not an image.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return read_exr_size(path)
    if suffix == ".npy":
        height, width = read_array(path).shape[:2]
        return height, width
    with _opened(path) as image:
        return _upright_size(image)


def _upright_size(image: Image.Image) -> tuple[int, int]:
    # Of TIFF files, Pillow gives the size after rotation.
    orientation = 1 if image.format == "TIFF" else _exif(image).get(ExifTags.Base.Orientation)
    quarter = orientation in (5, 6, 7, 8)
    return (image.width, image.height) if quarter else (image.height, image.width)


def read_pixels(path: Path, *, indices: bool) -> NDArray[Any]:
    """Read an image or an array as stored; alpha is dropped, the EXIF orientation applied.

    Args:
        path: An image of `IMAGE_FORMATS` (its first picture), OpenEXR (one channel of it) or
            ``.npy``.
        indices: Of an image with a palette (or of 1 bit), whether to give indices or colours.

    Returns:
        ``(H, W)`` where there is one channel, else ``(H, W, C)``, colours in RGB order. An array is
        memory-mapped and read-only.

    Raises:
        DataError: The file cannot be read or is broken, or its array is not an image.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return read_array(path)
    if suffix == ".exr":
        return read_exr(path)
    with _opened(path) as image:
        tiles = str(getattr(image, "tile", ""))  # how pixels are stored: "RGB;16B"
        if image.mode in ("RGB", "RGBA", "LA") and ";16" in tiles:
            return _decode_16_bit(path, grey=image.mode == "LA")
        oriented = ExifTags.Base.Orientation in _exif(image)
        image.load()
        upright = ImageOps.exif_transpose(image) if oriented else image
        if upright.mode in _SINGLE_CHANNEL or (upright.mode in ("1", "P") and indices):
            stored = np.array(upright, np.uint8 if upright.mode == "1" else None)
            return stored.astype(stored.dtype.newbyteorder("="), copy=False)
        if upright.mode == "LA":
            return np.array(upright.getchannel(0))
        upright.info.pop("transparency", None)  # Pillow warns that RGB loses it
        return np.array(upright if upright.mode == "RGB" else upright.convert("RGB"))


def _decode_16_bit(path: Path, *, grey: bool) -> NDArray[Any]:
    # From memory: `cv2.imread` knows no paths beyond the system's code page.
    pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise ValueError("broken pixels")
    return np.ascontiguousarray(pixels[..., 0] if grey else pixels[..., 2::-1])


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Decode the colours of an image, ``(H, W, 3)``.

    Of 16 bits per channel the upper 8 are kept; grey becomes three equal channels; alpha is
    dropped; the EXIF orientation is applied.

    Args:
        path: An image of `IMAGE_FORMATS`.

    Raises:
        DataError: The file cannot be read, is broken, or holds other values than colours.
    """
    pixels = read_pixels(path, indices=False)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.dtype != np.uint8 or pixels.shape[2:] not in ((), (3,)):
        raise DataError(
            path,
            found=f"{pixels.dtype} of shape {pixels.shape}",
            expected="colours of 8 or 16 bits",
            remedy="Export the image as JPEG or PNG.",
        )
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=-1)


def read_depth_m(path: Path, units_per_m: float) -> NDArray[np.float32]:
    """Read a depth map.

    Args:
        path: PNG, TIFF or array of integers, which are units; or TIFF, array or OpenEXR image of
            floats, which are metres.
        units_per_m: Units in a metre, 1000 for millimetres.

    Returns:
        ``(H, W)`` metres; 0 where depth is missing: where the file has 0 or less, NaN, infinity,
        more than 10 km or, of 16-bit integers, 65535.

    Raises:
        DataError: The file cannot be read, is broken, or holds no depth.
        SettingError: The units are not positive.
    """
    if not 0 < units_per_m < math.inf:
        raise SettingError("depth units per metre", found=units_per_m, expected="more than 0")
    stored = read_pixels(path, indices=True)
    if stored.ndim != 2 or stored.dtype in (np.uint8, np.bool_):
        raise DataError(
            path,
            found=f"{stored.dtype} of shape {stored.shape}",
            expected="depth: 16-bit grey PNG or TIFF, 32-bit float TIFF, .npy or .exr",
        )
    depth = stored.astype(np.float32)
    if stored.dtype.kind != "f":
        depth /= np.float32(units_per_m)
    missing = ~((depth > 0) & (depth <= _MOST_M))
    if stored.dtype == np.uint16:
        missing |= stored == _MISSING_UNITS
    depth[missing] = 0
    return depth


def read_array(path: Path) -> NDArray[Any]:
    """Memory-map the pixels of a ``.npy`` file, read-only.

    Returns:
        ``(H, W)`` or ``(H, W, C)`` numbers; of one channel without the last dimension.

    Raises:
        DataError: It cannot be read, or is not an array of pixels.
    """
    try:
        with np.errstate(over="ignore"):  # by the sizes in a broken header
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        usable = array.ndim in (2, 3) and 0 not in array.shape and array.dtype.kind in "buif"
    # Broken headers raise anything, also tokenize.TokenError; archives have no dimensions.
    except Exception as error:
        raise DataError(path, found=error, expected="one array, saved with numpy.save") from error
    if not usable:
        raise DataError(
            path,
            found=f"{array.dtype} of shape {array.shape}",
            expected="numbers of shape (H, W) or (H, W, C)",
        )
    pixels: NDArray[Any] = array
    return pixels[..., 0] if pixels.ndim == 3 and pixels.shape[-1] == 1 else pixels


def photo_fov_deg(path: Path) -> float | None:
    """Horizontal field of view of a photo in degrees, from its EXIF data.

    They hold the focal length of a camera with 36×24 mm film and the same field of view along the
    diagonal (CIPA DCG-001), whatever the aspect ratio of the photo.

    Returns:
        None if they lack it.

    Raises:
        DataError: The file cannot be read, or is not an image.
    """
    with _opened(path) as image:
        height, width = _upright_size(image)
        try:
            exif = _exif(image).get_ifd(ExifTags.IFD.Exif)
            film_mm = float(exif.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
        except Exception:  # broken EXIF data
            return None
    if not 0 < film_mm < math.inf:  # 0 stands for unknown
        return None
    focal_pixels = film_mm / _FILM_DIAGONAL_MM * math.hypot(height, width)
    return math.degrees(2 * math.atan(width / (2 * focal_pixels)))


def check_writable(suffix: str, dtype: DTypeLike, channels: int) -> None:
    """Refuse pixels that a file format cannot hold.

    Args:
        suffix: Of the file, in lower case, with the dot.
        dtype: Of the pixels.
        channels: Of the pixels.

    Raises:
        SettingError: The suffix is unknown, or such a file cannot hold such pixels.
    """
    able = [s for s in _WRITABLE if np.dtype(dtype).name in _WRITABLE[s] and channels in (1, 3)]
    if suffix not in (*able, ".npy"):
        raise SettingError(
            f"{suffix} files",
            found=f"{np.dtype(dtype)} pixels of {channels} channel{'s' if channels > 1 else ''}",
            expected=f"one that can hold them: {' or '.join((*able, '.npy'))}",
        )


@contextmanager
def array_file(path: Path, shape: tuple[int, ...], dtype: DTypeLike) -> Iterator[NDArray[Any]]:
    """A ``.npy`` file as an array to be filled by the block; it appears when that succeeds.

    Args:
        path: The file.
        shape: Of the array, which may be larger than the memory.
        dtype: Of the array.
    """
    with atomic_path(path) as temporary:
        array = open_memmap(temporary, "w+", dtype, shape)
        with temporary.open("r+b") as file:
            reserve(file, temporary.stat().st_size)
        yield array
        array.flush()


def write_pixels(path: Path, pixels: NDArray[Any]) -> None:
    """Write pixels unchanged, atomically.

    Args:
        path: The file; its suffix gives the format.
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
    done, encoded = cv2.imencode(suffix, ordered)
    if not done:
        found = f"{pixels.shape[0]}×{pixels.shape[1]} pixels"
        raise SettingError(path.name, found=found, expected=f"a size that {suffix} files can have")
    write_bytes(path, encoded.tobytes())
