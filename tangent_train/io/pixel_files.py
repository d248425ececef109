"""Reading and writing images: colors, depth, labels, arrays.

Pillow opens and identifies every image; OpenCV writes, and decodes what Pillow would cut to 8 bits
or read in the wrong byte order: 16-bit colors, and TIFF files of more than 8 bits.
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
from PIL import ExifTags, Image, TiffImagePlugin, UnidentifiedImageError
from PIL.ExifTags import Base as Tag

from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.files import atomic_path, reserve, write_bytes
from tangent_train.io.exr import read_exr, read_exr_size, write_exr
from tangent_train.io.image_files import IMAGE_FORMATS
from tangent_train.io.png import (
    MOST_PIXELS,
    check_pixels,
    read_png_header,
    read_png_metadata,
)

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
_LAYOUT = (
    *(Tag.BitsPerSample, Tag.SampleFormat, Tag.SamplesPerPixel, Tag.PhotometricInterpretation),
    *(Tag.Compression, Tag.PlanarConfiguration, Tag.ExtraSamples, Tag.FillOrder),
)
_ASSOCIATED_ALPHA = 1
_EXACT_TYPES = {
    (number, 8 * size): np.dtype(f"{kind}{size}")
    for number, kind, sizes in ((1, "u", (2, 4, 8)), (2, "i", (1, 2, 4)), (3, "f", (4, 8)))
    for size in sizes
}
"""Types of TIFF channels beyond 8 bits, by SampleFormat and BitsPerSample."""
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
            if isinstance(image, TiffImagePlugin.TiffImageFile):
                _seek_full_size(image)
            check_pixels(path, image.height, image.width)
            if image.format == "PNG":
                read_png_header(path)
                image.info |= read_png_metadata(path)
            yield image
    except (DataError, MemoryError):
        raise
    # Decoders of broken files raise anything, from OSError to SyntaxError and IndexError.
    except Exception as error:
        if isinstance(error, UnidentifiedImageError) and (tags := _complete_tiff_tags(path)):
            raise _unknown_layout(path, tags) from error
        reason = getattr(error, "strerror", None) or str(error).partition(" <")[0]
        raise DataError(
            path,
            found=f"no image that can be decoded ({reason})",
            expected=f"a whole image of a known format ({', '.join(IMAGE_FORMATS)})",
            remedy="Copy or export the file again, for example as JPEG or PNG.",
        ) from error


def _seek_full_size(image: TiffImagePlugin.TiffImageFile) -> None:
    """Go to the first page that is not a thumbnail; stay at the first page if all are."""
    for page in range(image.n_frames if image.tag_v2.get(Tag.NewSubfileType, 0) & 1 else 0):
        image.seek(page)
        if not image.tag_v2.get(Tag.NewSubfileType, 0) & 1:
            return
    image.seek(0)


def _complete_tiff_tags(path: Path) -> dict[int, Any]:
    """Return the tags of the first page of a complete TIFF file; of other files nothing."""
    try:
        with path.open("rb") as file:
            head = file.read(8)
            head += file.read(8) if head[2] == 43 else b""  # BigTIFF
            tags: Any = TiffImagePlugin.ImageFileDirectory_v2(head)
            file.seek(tags.next)
            tags.load(file)
        in_tiles = Tag.StripOffsets not in tags or Tag.StripByteCounts not in tags
        starts = tags[Tag.TileOffsets if in_tiles else Tag.StripOffsets]
        sizes = tags[Tag.TileByteCounts if in_tiles else Tag.StripByteCounts]
        return dict(tags) if np.add(starts, sizes).max() <= path.stat().st_size else {}
    except Exception:  # the parser raises many kinds of errors
        return {}


def _unknown_layout(path: Path, tags: Any) -> DataError:
    known = [f"{tag.name} {tags[tag]}" for tag in _LAYOUT if tag in tags]
    return DataError(
        path,
        found=f"a TIFF layout that cannot be decoded: {', '.join(known)}",
        expected="gray or RGB of 8 or 16 bits or depth of 32-bit float, all channels of one type, "
        "interleaved (PlanarConfiguration 1), without premultiplied alpha",
        remedy="Convert the image to PNG, or to TIFF of 8 or 16 bits; depth, to 32-bit float.",
    )


def _exif(image: Image.Image) -> Image.Exif:
    """Return the EXIF data; none if they are broken."""
    try:
        # Pillow would decode the pixels of a PNG file to look for more.
        return Image.Image.getexif(image)
    except Exception:  # the parser raises many kinds of errors
        return Image.Exif()


def read_metadata(path: Path) -> tuple[dict[Any, Any], list[bytes]]:
    """Read the metadata of an image file.

    Args:
        path: See `read_pixels`; arrays and OpenEXR images have no metadata.

    Returns:
        Texts and data by Pillow's names; the APP1 segments of a JPEG file.

    Raises:
        DataError: It cannot be read, or is not an image.
    """
    if path.suffix.lower() in (".npy", ".exr"):
        return {}, []
    with _opened(path) as image:
        segments = getattr(image, "applist", [])
        return image.info, [content for name, content in segments if name == "APP1"]


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
    with _opened(path) as image:
        return _upright_size(image)


def _orientation(image: Image.Image) -> int:
    """Return the EXIF orientation of the pixels that Pillow decodes, 1 to 8."""
    # Pillow rotates TIFF files itself.
    found: Any = 1 if image.format == "TIFF" else _exif(image).get(Tag.Orientation)
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
    with _opened(path) as image:
        size, orientation = _upright_size(image), _orientation(image)
        exact = _exact_type(path, image)
        pixels = (
            _decode(image, indices=indices)
            if exact is None
            else _decode_exactly(path, image.tell(), *exact)
        )
        pixels = _displayed(pixels, orientation)
        if pixels.shape[:2] != size:
            raise ValueError(f"{width_height(pixels.shape)}, in its header {width_height(size)}")
        return pixels


def _decode(image: Image.Image, *, indices: bool) -> NDArray[Any]:
    image.load()
    if image.mode in _SINGLE_CHANNEL or (image.mode in ("1", "P") and indices):
        stored = np.array(image, np.uint8 if image.mode == "1" else None)
        return stored.astype(stored.dtype.newbyteorder("="), copy=False)
    if image.mode == "LA":
        return np.array(image.getchannel(0))
    image.info.pop("transparency", None)  # Pillow warns that RGB loses it
    return np.array(image if image.mode == "RGB" else image.convert("RGB"))


def _exact_type(path: Path, image: Image.Image) -> tuple[np.dtype[Any], bool] | None:
    """Return the channel type of a file for OpenCV, and True for gray; None for Pillow.

    Raises:
        DataError: Neither of them decodes it correctly.
    """
    if image.format == "PNG":
        header = read_png_header(path)
        return (np.dtype(np.uint16), "gray" in header.color) if header.bits == 16 else None
    if not isinstance(image, TiffImagePlugin.TiffImageFile):
        return None
    tags: Any = image.tag_v2
    channels = tags.get(Tag.SamplesPerPixel, 1)
    bits, kinds = set(tags.get(Tag.BitsPerSample, (1,))), set(tags.get(Tag.SampleFormat, (1,)))
    if kinds == {1} and max(bits) <= 8:
        exact = None
        right = image.mode != "YCbCr" or tags.get(Tag.YCbCrSubSampling) == (1, 1)
        right &= (tags.get(Tag.PlanarConfiguration), tags.get(Tag.FillOrder)) != (2, 2)
    else:
        exact = _EXACT_TYPES.get((*kinds, *bits))
        is_plain = tags.get(Tag.PhotometricInterpretation) == {1: 1, 3: 2, 4: 2}.get(channels)
        is_interleaved = channels == 1 or tags.get(Tag.PlanarConfiguration, 1) == 1
        is_straight = _ASSOCIATED_ALPHA not in tags.get(Tag.ExtraSamples, ())
        right = exact is not None and is_plain and is_interleaved and is_straight
    if not right:
        raise _unknown_layout(path, tags)
    return None if exact is None else (exact, channels == 1)


def _decode_exactly(path: Path, page: int, dtype: np.dtype[Any], gray: bool) -> NDArray[Any]:
    # From memory: `cv2.imread` cannot open paths beyond the system's code page.
    content = np.fromfile(path, np.uint8)
    if page:
        _, pages = cv2.imdecodemulti(content, cv2.IMREAD_UNCHANGED, range=(page, page + 1))
    else:
        pages = [cv2.imdecode(content, cv2.IMREAD_UNCHANGED)]
    pixels: Any = pages[0]
    if pixels is None or pixels.dtype != dtype or pixels.shape[2:] not in ((), (3,), (4,)):
        raise ValueError("broken pixels")
    if gray:
        return np.ascontiguousarray(pixels.reshape(*pixels.shape[:2], -1)[..., 0])
    return pixels[..., 2::-1]


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
            exif = _exif(image).get_ifd(ExifTags.IFD.Exif)
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
