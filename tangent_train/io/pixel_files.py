"""Reading and writing images: colors, depth, labels, arrays.

Pillow decodes images of 8 bits and 16-bit gray PNG files, tifffile TIFF files of more than 8 bits,
OpenCV 16-bit colors in PNG and LZW; OpenCV writes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.lib.format import open_memmap
from numpy.typing import DTypeLike, NDArray
from PIL import ExifTags, Image
from PIL.ExifTags import Base as Tag

from tangent_train.errors import DataError, SettingError, first_line, width_height
from tangent_train.files import atomic_path, reserve, write_bytes
from tangent_train.io.exr import read_exr, read_exr_size, write_exr
from tangent_train.io.image_files import IMAGE_FORMATS
from tangent_train.io.png import MOST_PIXELS, check_pixels, read_png_header

LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
"""Formats that change pixels slightly: not for labels and depth."""

_WRITABLE = {
    ".png": ("uint8", "uint16"),
    **dict.fromkeys(LOSSY_SUFFIXES, ("uint8",)),
    **dict.fromkeys((".tif", ".tiff"), ("uint8", "uint16", "float32")),
}
"""Pixel types by suffix; ``.npy`` holds all types."""

PIXEL_SUFFIXES = (*_WRITABLE, ".npy")
"""Suffixes that `write_pixels` takes, in lower case."""

READABLE_SUFFIXES = (*PIXEL_SUFFIXES, ".exr")
"""Suffixes that `read_pixels` takes."""

_SINGLE_CHANNEL = ("L", "I", "F", "I;16", "I;16L", "I;16B", "I;16N")
_FIRST_TRANSPOSED = 5  # EXIF orientation from which rows are stored as columns
_BYTE_BITS = 8
_UNSIGNED = 1  # SampleFormat of TIFF
_MAX_DEPTH_M = 1e4  # larger depth is missing: some files have 1e10 there
_MISSING_UNITS = 65535
_FILM_DIAGONAL_MM = math.hypot(36, 24)

Image.MAX_IMAGE_PIXELS = MOST_PIXELS


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """Open an image of an allowed size without decoding; errors in the block name the file."""
    try:
        # Not by its name: Pillow would map raw TIFF files into memory and rotate them wrongly.
        with path.open("rb") as file, Image.open(file, formats=IMAGE_FORMATS) as image:
            check_pixels(path, image.height, image.width)
            yield image
    except (DataError, MemoryError):
        raise
    # Decoders of broken files raise anything, from OSError to SyntaxError and IndexError.
    except Exception as error:
        reason = getattr(error, "strerror", None) or str(error).partition(" <")[0]
        raise DataError(
            path,
            found=f"no image that can be decoded ({reason})",
            expected=f"a whole image of a known format ({', '.join(IMAGE_FORMATS)})",
            remedy="Copy or export the file again, for example as JPEG or PNG.",
        ) from error


def read_xmp(path: Path) -> bytes:
    """Read the XMP packet of an image file, empty without one.

    Args:
        path: See `read_pixels`; arrays and OpenEXR images have no packet.

    Raises:
        DataError: It cannot be read, or is not an image.
    """
    if path.suffix.lower() in (".npy", ".exr"):
        return b""
    with _opened(path) as image:
        if image.format == "PNG":
            image.load()  # programs write the packet behind the pixels too
        packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    return packet.encode() if isinstance(packet, str) else bytes(packet)


def read_image_size(path: Path) -> tuple[int, int]:
    """Read the rows and columns that `read_pixels` would return from the header of a file.

    Raises:
        DataError: It cannot be read, or is not an image.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return read_exr_size(path)
    if suffix == ".npy":
        height, width = read_array(path).shape[:2]
        return height, width
    if page := _deep_tiff(path):
        rows, columns = page.imagelength, page.imagewidth
        check_pixels(path, rows, columns)
        return (columns, rows) if _tiff_orientation(page) >= _FIRST_TRANSPOSED else (rows, columns)
    with _opened(path) as image:
        return _upright_size(image)


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


def _upright_size(image: Image.Image) -> tuple[int, int]:
    quarter = _orientation(image) >= _FIRST_TRANSPOSED
    return (image.width, image.height) if quarter else (image.height, image.width)


def _displayed(pixels: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Rotate pixels by their EXIF orientation (CIPA DC-008, tag 274)."""
    pixels = pixels.swapaxes(0, 1) if orientation >= _FIRST_TRANSPOSED else pixels
    pixels = pixels[:, ::-1] if orientation in (2, 3, 6, 7) else pixels
    pixels = pixels[::-1] if orientation in (3, 4, 7, 8) else pixels
    return np.ascontiguousarray(pixels)


def read_pixels(path: Path, *, indices: bool) -> NDArray[Any]:
    """Read an image or an array as stored; alpha is dropped, the EXIF orientation applied.

    Args:
        path: An image of `IMAGE_FORMATS` (its first picture), OpenEXR (one channel of it) or
            ``.npy``.
        indices: True to read indices, not colors, from images with a palette or of 1 bit.

    Returns:
        ``(H, W)`` for one channel, else ``(H, W, C)``, colors in RGB order. Arrays are
        memory-mapped and read-only.

    Raises:
        DataError: The file cannot be read or is broken, or its array is not an image.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return read_array(path)
    if suffix == ".exr":
        return read_exr(path)
    if page := _deep_tiff(path):
        return _displayed(_decode_tiff(path, page), _tiff_orientation(page))
    with _opened(path) as image:
        orientation = _orientation(image)
        header = read_png_header(path) if image.format == "PNG" else None
        if header and header.bits > _BYTE_BITS:  # Pillow would cut colors to 8 bits
            image.load()  # refuses truncated files
            pixels = _decode_deep(path)
            pixels = pixels[..., 0] if pixels.ndim > 2 and "gray" in header.color else pixels
        else:
            pixels = _decode(image, indices=indices)
        return _displayed(pixels, orientation)


def _decode(image: Image.Image, *, indices: bool) -> NDArray[Any]:
    image.load()
    if image.mode in _SINGLE_CHANNEL or (image.mode in ("1", "P") and indices):
        stored = np.array(image, np.uint8 if image.mode == "1" else None)
        return stored.astype(stored.dtype.newbyteorder("="), copy=False)
    if image.mode == "LA":
        return np.array(image.getchannel(0))
    if image.mode == "YCbCr":
        raise ValueError("subsampled colors")
    image.info.pop("transparency", None)  # Pillow warns that RGB loses it
    return np.array(image if image.mode == "RGB" else image.convert("RGB"))


def _decode_deep(path: Path) -> NDArray[Any]:
    # From memory: `cv2.imread` cannot open paths beyond the system's code page.
    pixels: Any = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype == np.uint8:
        raise ValueError("pixels that OpenCV does not decode")
    return pixels if pixels.ndim == 2 else pixels[..., 2::-1]


def _deep_tiff(path: Path) -> Any:
    """Return the page that tifffile decodes, the first of full size; None to use Pillow."""
    if path.suffix.lower() not in (".tif", ".tiff"):
        return None
    try:
        with tifffile.TiffFile(path) as file:
            pages: Any = file.pages
            page = next((one for one in pages if not one.is_reduced), pages[0])
    except Exception:  # the parser raises many kinds of errors; Pillow names them
        return None
    is_unsigned = page.sampleformat == _UNSIGNED
    is_shallow = is_unsigned and np.max(page.bitspersample) <= _BYTE_BITS
    is_shallow &= page.fillorder == tifffile.FILLORDER.MSB2LSB
    return None if is_shallow and page.index == 0 else page


def _tiff_orientation(page: Any) -> int:
    found = page.tags.valueof(Tag.Orientation)
    return found if found in range(1, 9) else 1


def _decode_tiff(path: Path, page: Any) -> NDArray[Any]:
    """Decode the gray or RGB pixels of a page, without alpha."""
    channels = page.samplesperpixel
    colors = tifffile.PHOTOMETRIC.MINISBLACK if channels == 1 else tifffile.PHOTOMETRIC.RGB
    is_plain = channels in (1, 3, 4) and page.photometric == colors
    is_plain &= tifffile.EXTRASAMPLE.ASSOCALPHA not in page.extrasamples
    is_planar = channels > 1 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE
    try:
        check_pixels(path, page.imagelength, page.imagewidth)
        if page.compression != tifffile.COMPRESSION.LZW:
            with tifffile.TiffFile(path) as file:
                pixels = file.asarray(key=page.index)
        elif is_planar or page.index:
            raise ValueError("LZW")  # noqa: TRY301
        else:  # tifffile needs another package for LZW
            pixels = _decode_deep(path)
    except DataError:
        raise
    except Exception as error:  # codecs raise many kinds of errors
        is_plain, reason = False, first_line(error)
    else:
        reason = f"{page.bitspersample} bits, {channels} channels, {page.photometric!r}"
    if not is_plain:
        raise DataError(
            path,
            found=f"a TIFF layout that cannot be decoded ({reason})",
            expected="gray or RGB of 8 or 16 bits or depth of 32-bit float, without premultiplied "
            "alpha",
            remedy="Convert the image to PNG, or to TIFF of 8 or 16 bits; depth, to 32-bit float.",
        )
    pixels = np.moveaxis(pixels, 0, -1) if is_planar else pixels
    pixels = pixels.astype(pixels.dtype.newbyteorder("="), copy=False)
    return pixels if channels == 1 else pixels[..., :3]


def read_rgb(image: Path | Image.Image) -> NDArray[np.uint8]:
    """Decode the colors of an image, ``(H, W, 3)``.

    The upper 8 of 16 bits per channel are kept; gray becomes three equal channels; alpha is
    dropped; the EXIF orientation is applied.

    Args:
        image: A file of `IMAGE_FORMATS`, or a Pillow image, which is not changed.

    Raises:
        DataError: The file cannot be read, is broken, or does not hold colors.
    """
    if isinstance(image, Path):
        pixels = read_pixels(image, indices=False)
    else:
        pixels = _displayed(_decode(image.copy(), indices=False), _orientation(image))
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    if pixels.dtype != np.uint8 or pixels.shape[2:] not in ((), (3,)):
        raise DataError(
            image if isinstance(image, Path) else "image",
            found=f"{pixels.dtype} of shape {pixels.shape}",
            expected="colors of 8 or 16 bits",
            remedy="Export the image as JPEG or PNG.",
        )
    return pixels if pixels.ndim == 3 else np.repeat(pixels[..., None], 3, axis=-1)


def read_depth_m(path: Path, units_per_m: float) -> NDArray[np.float32]:
    """Read a depth map.

    Args:
        path: PNG, TIFF or array of integers, in units; or TIFF, array or OpenEXR image of
            floats, in meters.
        units_per_m: Units in a meter, 1000 for millimeters.

    Returns:
        ``(H, W)`` meters; 0 where depth is missing: at values of 0 or less, NaN, infinity, more
        than 10 km and, in 16-bit integers, 65535.

    Raises:
        DataError: The file cannot be read, is broken, or holds no depth.
        SettingError: The units are not positive.
    """
    if not 0 < units_per_m < math.inf:
        raise SettingError("depth units per meter", found=units_per_m, expected="more than 0")
    stored = read_pixels(path, indices=True)
    if stored.ndim != 2 or stored.dtype in (np.uint8, np.bool_):
        raise DataError(
            path,
            found=f"{stored.dtype} of shape {stored.shape}",
            expected="depth: 16-bit gray PNG or TIFF, 32-bit float TIFF, .npy or .exr",
        )
    depth = stored.astype(np.float32)
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


def read_array(path: Path) -> NDArray[Any]:
    """Memory-map the pixels of a ``.npy`` file, read-only.

    Returns:
        ``(H, W)`` or ``(H, W, C)`` numbers; a last dimension of one channel is dropped.

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
    """Read the horizontal field of view of a photo in degrees from its EXIF data.

    EXIF data hold the focal length of a camera with 36×24 mm film and the same field of view along
    the diagonal (CIPA DCG-001), for all aspect ratios of the photo.

    Returns:
        None if they do not hold it.

    Raises:
        DataError: The file cannot be read, or is not an image.
    """
    with _opened(path) as image:
        height, width = _upright_size(image)
        try:
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
