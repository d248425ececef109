"""Reading and writing images: colors, depth, labels, arrays.

`decoders` decodes images of 8 bits, tifffile TIFF files of more than 8 bits, OpenCV PNG and LZW of
more than 8 bits, OpenEXR its own format; OpenCV writes.
"""

from __future__ import annotations

import math
import mmap
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

import cv2
import numpy as np
import tifffile
from numpy.lib.format import open_memmap
from numpy.typing import DTypeLike, NDArray
from PIL import ExifTags, Image
from PIL.ExifTags import Base as Tag

from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, of_extra, width_height
from tangent_train.files import atomic_path, checked_file, reserve, write_bytes
from tangent_train.io.decoders import decode_by_opencv, deep_to_srgb, load_whole, to_srgb
from tangent_train.io.exr import open_exr, write_exr
from tangent_train.io.image_files import (
    HEIF_SUFFIXES,
    IMAGE_FORMATS,
    IMAGE_SUFFIXES,
    MOST_PIXELS,
)

LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
"""Formats that change pixels slightly: not for labels and depth."""

_TIFF_SUFFIXES = (".tif", ".tiff")
_WRITABLE = {
    ".png": ("uint8", "uint16"),
    **dict.fromkeys(LOSSY_SUFFIXES, ("uint8",)),
    **dict.fromkeys(_TIFF_SUFFIXES, ("uint8", "uint16", "float32")),
}
"""Pixel types by suffix; ``.npy`` holds all types."""

READABLE_SUFFIXES = (*_WRITABLE, ".npy", ".exr")
"""Suffixes that `read_pixels` takes, in lower case."""

_SINGLE_CHANNEL = ("L", "I", "F", "I;16", "I;16L", "I;16B", "I;16N")
_FULL_RANGE = 2**14  # 16-bit colors below it probably have 14 bits or fewer
_has_warned = mmap.mmap(-1, 1)  # shared with forked processes, which read training data
_MOST_XMP = 2**24
_FIRST_TRANSPOSED = 5  # EXIF orientation from which rows are stored as columns
_UNSIGNED = 1  # SampleFormat of TIFF
_MAX_DEPTH_M = 1e4  # larger depth is missing: some files have 1e10 there
_MISSING_UNITS = 65535
_FILM_DIAGONAL_MM = math.hypot(36, 24)

Image.MAX_IMAGE_PIXELS = MOST_PIXELS


_Meaning = Literal["indices", "values", "colors"]
"""Pixels as indices of a palette, as stored values, or as colors in sRGB."""


class _StoredImage(NamedTuple):
    """An open image file.

    Attributes:
        size: Rows and columns as stored.
        decode: Returns the pixels, as one of `_Meaning`.
        orientation: EXIF orientation of these pixels, 1 to 8.
        profile: ICC profile of colors of more than 8 bits, which are decoded as stored.
    """

    size: tuple[int, int]
    decode: Callable[[Any], NDArray[Any]]
    orientation: int = 1
    profile: bytes | None = None


@contextmanager
def _opened(path: Path, channel: str | None = None) -> Iterator[_StoredImage]:
    """Open an image of an allowed size without decoding; errors in the block name the file."""
    try:
        # Not by its name: Pillow would map raw TIFF files into memory and rotate them wrongly.
        with checked_file(path).open("rb") as file:
            stored = _open_stored(path, file, channel)
            if not 0 < math.prod(stored.size) <= MOST_PIXELS:
                raise ValueError(f"{width_height(stored.size)}; 1 to {MOST_PIXELS} pixels")  # noqa: TRY301
            yield stored
    except (SettingError, DataError):  # a missing package, or no such channel
        raise
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        raise DataError(path, found=error, expected="an image file") from error
    # Decoders of broken files raise anything, from OSError to SyntaxError and IndexError.
    except Exception as error:
        reason = getattr(error, "strerror", None) or str(error).partition(" <")[0]
        raise DataError(
            path,
            found=f"no image that can be decoded ({reason})",
            expected=f"a whole image ({', '.join(IMAGE_FORMATS)}), .npy array or OpenEXR image",
            remedy="Copy or export the file again, for example as JPEG or PNG, or depth as a "
            "16-bit PNG or a float TIFF.",
        ) from error


def _open_stored(path: Path, file: IO[bytes], channel: str | None) -> _StoredImage:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        with np.errstate(over="ignore"):  # by the sizes in a broken header
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        array = array[..., 0] if array.ndim == 3 and array.shape[-1] == 1 else array
        height, width, *_ = array.shape
        return _StoredImage((height, width), lambda _: array)
    if suffix == ".exr":
        size, decode_exr = open_exr(path, channel)
        return _StoredImage(size, lambda meaning: decode_exr(meaning == "indices"))
    if suffix in HEIF_SUFFIXES:
        with of_extra("heif", path, "Or convert the file to JPEG."):
            import pillow_heif  # noqa: F401
    page = _deep_page(file) if suffix in _TIFF_SUFFIXES else None
    if page is not None:
        found = page.tags.valueof(Tag.Orientation)
        orientation = found if found in range(1, 9) else 1
        profile, size = (
            page.tags.valueof(Tag.InterColorProfile),
            (page.imagelength, page.imagewidth),
        )
        return _StoredImage(size, lambda _: _decode_deep_tiff(file, page), orientation, profile)
    file.seek(0)
    image = Image.open(file, formats=IMAGE_FORMATS)
    size, orientation = (image.height, image.width), _orientation(image)
    layout = str(image.tile[0][3]) if image.format == "PNG" else ""
    if layout.endswith("16B"):  # Pillow would cut colors to 8 bits
        profile = image.info.get("icc_profile")
        return _StoredImage(
            size, lambda _: _decode_deep_png(file, image, layout), orientation, profile
        )
    return _StoredImage(size, partial(_decode, image, file), orientation)


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation of the pixels that Pillow decodes, 1 to 8."""
    if image.format == "TIFF":  # Pillow rotates these files itself
        return 1
    try:
        # Pillow's own method would decode the pixels of a PNG file to look for more.
        found: Any = Image.Image.getexif(image).get(Tag.Orientation)
    except Exception:  # the parser raises many kinds of errors
        return 1
    return found if found in range(1, 9) else 1


def _decode(image: Image.Image, file: IO[bytes] | None, meaning: _Meaning) -> NDArray[Any]:
    """Decode an image of 8 bits from its file, or one that is decoded already."""
    whole = image if file is None else load_whole(image, file)
    profile = image.info.get("icc_profile") if meaning == "colors" else None
    if isinstance(whole, np.ndarray) and not profile:
        return whole
    image = Image.fromarray(whole) if isinstance(whole, np.ndarray) else whole
    is_single = image.mode in _SINGLE_CHANNEL and not (meaning == "colors" and image.mode == "L")
    if is_single or (image.mode in ("1", "P") and meaning == "indices"):
        stored = np.array(image, np.uint8 if image.mode == "1" else None)
        return stored.astype(stored.dtype.newbyteorder("="), copy=False)
    if image.mode == "YCbCr":
        raise ValueError("subsampled colors")
    image.info.pop("transparency", None)  # Pillow warns that RGB loses it
    if image.mode == "LA":
        image = image.getchannel(0)
    elif image.mode not in ("L", "RGB", "CMYK"):
        profile = None if image.mode == "LAB" else profile
        image = image.convert("RGB")
    image = to_srgb(image, profile, getattr(file, "name", "image"))
    return np.array(image if image.mode in ("L", "RGB") else image.convert("RGB"))


def _decode_deep_png(file: IO[bytes], image: Image.Image, layout: str) -> NDArray[Any]:
    load_whole(image, file)
    pixels = decode_by_opencv(file, cv2.IMREAD_UNCHANGED)
    pixels = pixels if pixels.ndim == 2 else pixels[..., 2::-1]
    return pixels[..., 0] if layout.startswith("LA") else pixels


def _deep_page(file: IO[bytes]) -> Any:
    """Return the page that tifffile decodes, the first of full size; None to use Pillow."""
    try:
        pages: Any = tifffile.TiffFile(file).pages
        page = next((one for one in pages if not one.is_reduced), pages[0])
    except Exception:  # the parser raises many kinds of errors; Pillow names them
        return None
    is_shallow = page.sampleformat == _UNSIGNED and np.max(page.bitspersample) <= 8
    is_shallow &= page.fillorder == tifffile.FILLORDER.MSB2LSB
    return None if is_shallow and page.index == 0 else page


def _decode_deep_tiff(file: IO[bytes], page: Any) -> NDArray[Any]:
    """Decode the gray or RGB pixels of a page, without alpha."""
    channels = page.samplesperpixel
    colors = tifffile.PHOTOMETRIC.MINISBLACK if channels == 1 else tifffile.PHOTOMETRIC.RGB
    is_plain = channels in (1, 3, 4) and page.photometric == colors
    is_plain &= tifffile.EXTRASAMPLE.ASSOCALPHA not in page.extrasamples
    is_planar = channels > 1 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE
    is_lzw = page.compression == tifffile.COMPRESSION.LZW  # tifffile needs another package for it
    if not is_plain or (is_lzw and (is_planar or page.index)):
        raise ValueError(f"TIFF layout: {channels} channels, {page.photometric!r}")
    pixels = decode_by_opencv(file, cv2.IMREAD_UNCHANGED) if is_lzw else page.asarray()
    pixels = pixels[..., 2::-1] if is_lzw and channels > 1 else pixels
    pixels = np.moveaxis(pixels, 0, -1) if is_planar else pixels
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels[..., :3]


def _displayed(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Rotate pixels by their EXIF orientation (CIPA DC-008, tag 274)."""
    if orientation == 1:
        return pixels
    pixels = pixels.swapaxes(0, 1) if orientation >= _FIRST_TRANSPOSED else pixels
    pixels = pixels[:, ::-1] if orientation in (2, 3, 6, 7) else pixels
    pixels = pixels[::-1] if orientation in (3, 4, 7, 8) else pixels
    return np.ascontiguousarray(pixels)


def read_xmp(path: Path) -> bytes:
    """Read the XMP packet of an image file; empty without one, and for other files.

    Raises:
        DataError: It cannot be read, or is not an image.
    """
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        return b""
    with _opened(path), Image.open(path, formats=IMAGE_FORMATS) as image:
        if image.format != "PNG":
            return bytes(image.info.get("xmp", b""))
    return _png_xmp(path)


def _png_xmp(path: Path) -> bytes:
    """Return the XMP packet of a PNG file, which many programs write behind the pixels."""
    with path.open("rb") as file:
        file.seek(8)
        while len(header := file.read(8)) == 8:
            length, name = struct.unpack(">I4s", header)
            if name != b"iTXt":
                file.seek(length + 4, os.SEEK_CUR)  # and its checksum
                continue
            keyword, _, content = file.read(length).partition(b"\0")
            file.seek(4, os.SEEK_CUR)
            if keyword == b"XML:com.adobe.xmp":
                text = content[2:].split(b"\0", 2)[-1]
                is_packed = content[:1] == b"\1"
                return zlib.decompressobj().decompress(text, _MOST_XMP) if is_packed else text
    return b""


def read_image_size(path: Path) -> tuple[int, int]:
    """Read the rows and columns that `read_pixels` would return from the header of a file.

    Raises:
        DataError: It cannot be read, or is not an image.
    """
    with _opened(path) as stored:
        height, width = stored.size
        return (width, height) if stored.orientation >= _FIRST_TRANSPOSED else (height, width)


def read_pixels(
    path: Path, *, indices: bool, in_srgb: bool = False, channel: str | None = None
) -> NDArray[Any]:
    """Read an image or an array as stored; alpha is dropped, the EXIF orientation applied.

    Args:
        path: An image of `IMAGE_FORMATS` (its first picture), OpenEXR (see `open_exr`) or ``.npy``.
        indices: True to read indices, not colors, from images with a palette or of 1 bit, and
            depth, not colors, from OpenEXR images.
        in_srgb: True to convert colors by an embedded color profile to sRGB.
        channel: Channel of OpenEXR images; None as `open_exr` chooses it.

    Returns:
        ``(H, W)`` for one channel, else ``(H, W, C)``, colors in RGB order. Arrays are
        memory-mapped and read-only.

    Raises:
        DataError: The file cannot be read or is broken, or its array is not an image.
    """
    with _opened(path, channel) as stored:
        pixels = stored.decode("indices" if indices else "colors" if in_srgb else "values")
        if in_srgb and stored.profile and pixels.dtype == np.uint16:
            pixels = deep_to_srgb(pixels, stored.profile, path)
        return _displayed(pixels, stored.orientation)


def _check_pixels(
    subject: object, pixels: NDArray[Any], expected: str, *, is_usable: bool
) -> NDArray[Any]:
    if not is_usable:
        found = f"{pixels.dtype} of shape {pixels.shape}"
        raise DataError(subject, found=found, expected=expected)
    return pixels


def _warn_of_range(subject: object, largest: int) -> None:
    """Print, once in a run, that 16-bit colors have fewer bits."""
    if 0 < largest < _FULL_RANGE and not _has_warned[0]:
        _has_warned[0] = 1
        print_text(
            f"Warning: {subject}: the largest value of 16-bit colors is {largest}, of 65535; they "
            "are read as dark. If images have fewer bits, scale their values to 65535.",
            error=True,
        )


def has_warned_of_range() -> bool:
    """Return True if this run has printed that 16-bit colors have fewer bits."""
    return bool(_has_warned[0])


def read_rgb(image: Path | Image.Image, *, as_stored: bool = False) -> NDArray[np.uint8]:
    """Decode the colors of an image, ``(H, W, 3)``, in sRGB.

    An embedded color profile is applied; the upper 8 of 16 bits per channel are kept; gray becomes
    three equal channels; alpha is dropped; the EXIF orientation is applied.

    Args:
        image: A file of `IMAGE_FORMATS`, or a Pillow image, which is not changed.
        as_stored: True to ignore the profile, e.g. for labels in colors.

    Raises:
        DataError: The file cannot be read, is broken, or does not hold colors.
    """
    if isinstance(image, Path):
        pixels = read_pixels(image, indices=False, in_srgb=not as_stored)
    else:
        pixels = _displayed(_decode(image.copy(), None, "colors"), _orientation(image))
    if pixels.dtype == np.uint16:
        if not as_stored:  # not labels
            _warn_of_range(image if isinstance(image, Path) else "image", int(pixels.max()))
        pixels = (pixels >> 8).astype(np.uint8)
    subject = image if isinstance(image, Path) else "image"
    is_usable = pixels.dtype == np.uint8 and pixels.shape[2:] in ((), (3,))
    _check_pixels(subject, pixels, "colors of 8 or 16 bits, as JPEG or PNG", is_usable=is_usable)
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=-1)


def read_depth_m(path: Path, units_per_m: float, channel: str | None = None) -> NDArray[np.float32]:
    """Read a depth map.

    Args:
        path: PNG, TIFF or array of integers, in units; or TIFF, array or OpenEXR image of
            floats, in meters.
        units_per_m: Units in a meter, 1000 for millimeters.
        channel: Channel of OpenEXR images; None for the channel of depth, see `open_exr`.

    Returns:
        ``(H, W)`` meters; 0 where depth is missing: at values of 0 or less, NaN, infinity, more
        than 10 km and, in 16-bit integers, 65535.

    Raises:
        DataError: The file cannot be read, is broken, or holds no depth.
    """
    stored = read_pixels(path, indices=True, channel=channel)
    is_usable = stored.ndim == 2 and stored.dtype not in (np.uint8, np.bool_)
    expected = "depth: 16-bit gray PNG or TIFF, 32-bit float TIFF, .npy or .exr"
    depth = _check_pixels(path, stored, expected, is_usable=is_usable).astype(np.float32)
    if stored.dtype.kind != "f":
        depth /= np.float32(units_per_m)
    missing = ~((depth > 0) & (depth <= _MAX_DEPTH_M))
    if stored.dtype == np.uint16:
        missing |= stored == _MISSING_UNITS
    depth[missing] = 0
    return depth


def most_depth_m(suffix: str, units_per_m: float) -> float:
    """Return the largest depth that `write_depth_m` writes to files of a suffix."""
    return (_MISSING_UNITS - 1) / units_per_m if suffix == ".png" else math.inf


def write_depth_m(path: Path, depth_m: NDArray[np.floating], units_per_m: float) -> None:
    """Write a depth map that `read_depth_m` reads.

    Args:
        path: 16-bit PNG, ``.npy`` or OpenEXR image; the last two hold float32 meters.
        depth_m: ``(H, W)`` meters, NaN where unknown.
        units_per_m: Units per meter in a PNG file, where 0 is unknown. Depth beyond `most_depth_m`
            becomes unknown too.
    """
    if path.suffix != ".png":
        write = write_exr if path.suffix == ".exr" else write_pixels
        write(path, np.asarray(depth_m, np.float32))
        return
    units = np.maximum(np.rint(np.asarray(depth_m, np.float64) * units_per_m), 1)
    is_written = (depth_m > 0) & (units < _MISSING_UNITS)
    write_pixels(path, np.where(is_written, units, 0).astype(np.uint16))


def photo_fov_deg(path: Path) -> float | None:
    """Read the horizontal field of view of a photo in degrees from its EXIF data.

    EXIF data hold the focal length of a camera with 36×24 mm film and the same field of view along
    the diagonal (CIPA DCG-001), for all aspect ratios of the photo.

    Returns:
        None if they do not hold it.

    Raises:
        DataError: The file cannot be read, or is not an image.
    """
    height, width = read_image_size(path)
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            exif = image.getexif().get_ifd(ExifTags.IFD.Exif)
        film_mm = float(exif.get(Tag.FocalLengthIn35mmFilm, 0))
    except Exception:  # broken EXIF data
        return None
    if not 0 < film_mm < math.inf:  # 0 stands for unknown
        return None
    focal_pixels = film_mm / _FILM_DIAGONAL_MM * math.hypot(height, width)
    return math.degrees(2 * math.atan(width / (2 * focal_pixels)))


def check_writable(suffix: str, dtype: DTypeLike, channels: int) -> None:
    """Refuse pixels that a file format cannot hold.

    Args:
        suffix: Suffix of the file, in lower case, with the dot.
        dtype: Type of the pixels.
        channels: Number of channels.

    Raises:
        SettingError: The suffix is unknown, or the format cannot hold such pixels.
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
    """Open a ``.npy`` file as an array to be filled by the block; it appears when that succeeds.

    Args:
        path: The file.
        shape: Shape of the array, which may be larger than the memory.
        dtype: Type of the array.
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
        path: The file; its suffix is the format.
        pixels: ``(H, W)`` or ``(H, W, C)``, colors in RGB order.

    Raises:
        SettingError: The format cannot hold them.
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
        found = width_height(pixels.shape)
        raise SettingError(path.name, found=found, expected=f"a size that {suffix} files can have")
    write_bytes(path, encoded.tobytes())
