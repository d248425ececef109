"""Opening image files of any origin through Pillow, with errors that say what is wrong."""

from __future__ import annotations

import os
import struct
from contextlib import contextmanager
from typing import TYPE_CHECKING

from PIL import ExifTags, Image

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

__all__ = ["MOST_PIXELS", "check_pixels", "open_image", "oriented_array", "oriented_size"]

_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP")

MOST_PIXELS = "TANGENT_MOST_PIXELS"
"""Variable of the environment, which all processes of a run share: pixels of an image that is
decoded, at most. A file of a few kilobytes can promise more than fit into memory."""

_MOST = 32768 * 16384

_CHANNELS = {2: 3, 4: 2, 6: 4}  # of PNG's types of colour; all others have one
_MOST_DEFLATED = 1032  # bytes of one: deflate copies 258 with two bits

# EXIF orientation: are rows and columns exchanged, and which of them run backwards afterwards?
_ORIENTATIONS = {
    2: (False, 1, -1),
    3: (False, -1, -1),
    4: (False, -1, 1),
    5: (True, 1, 1),
    6: (True, 1, -1),
    7: (True, -1, -1),
    8: (True, -1, 1),
}


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Open a JPEG, PNG, TIFF or WebP file, whatever its name ends in; nothing is decoded yet.

    Args:
        path: The file.

    Yields:
        The image; of several in one file, the first.

    Raises:
        DataError: It cannot be read, is none of these, is too large, or turns out to be broken
            while the block reads it.
    """
    most = _most_pixels()
    _allow_panoramas(most)
    try:
        with Image.open(path, formats=_FORMATS) as image:
            check_pixels(path, image.height, image.width)
            yield image
    except (DataError, MemoryError):
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise _too_large(path, error, most) from error
    # Decoders that meet a broken file raise anything from OSError to SyntaxError and IndexError.
    except Exception as error:
        raise DataError(
            path,
            found=_reason(error),
            expected="a whole JPEG, PNG, TIFF or WebP image",
            remedy="Copy or export the file again.",
        ) from error


def check_pixels(path: Path, height: int, width: int) -> None:
    """Refuse an image that is too large to be decoded, by what its header says.

    Args:
        path: The file, for the message.
        height: Rows.
        width: Columns.

    Raises:
        DataError: It has more pixels than `MOST_PIXELS` allows.
        SettingError: That is no number.
    """
    most = _most_pixels()
    if height * width > most:
        raise _too_large(path, f"{height}×{width} pixels", most)
    _check_deflated(path)


def _check_deflated(path: Path) -> None:
    """Refuse a PNG too short for its pixels: decoders take the memory for all of them first."""
    try:
        with path.open("rb") as file:
            start = file.read(26)
            size = file.seek(0, os.SEEK_END)
    except OSError:
        return  # said by who reads it
    if not start.startswith(b"\x89PNG\r\n\x1a\n") or len(start) < 26:
        return
    width, height, bits, color = struct.unpack(">IIBB", start[16:26])
    least = height * (width * bits * _CHANNELS.get(color, 1) // 8 + 1) / _MOST_DEFLATED
    if size < least:
        raise DataError(
            path,
            found=f"a header of {height}×{width} pixels, and {size} bytes",
            expected=f"{least:.0f} bytes at least, with which a PNG can hold so many",
            remedy="Copy or export the file again.",
        )


def _most_pixels() -> int:
    text = os.environ.get(MOST_PIXELS, str(_MOST))
    if not text.isdecimal() or int(text) < 1:
        raise SettingError(MOST_PIXELS, found=repr(text), expected="a whole number, 1 or more")
    return int(text)


def oriented_size(image: Image.Image) -> tuple[int, int]:
    """Rows and columns of an image as it is to be looked at, from its header."""
    exchanged, _, _ = _orientation(image)
    return (image.width, image.height) if exchanged else (image.height, image.width)


def oriented_array(array: NDArray[Any], image: Image.Image) -> NDArray[Any]:
    """Turn the pixels of `image` as its EXIF orientation says.

    Args:
        array: ``(H, W[, C])`` as stored.
        image: Where they are from.

    Returns:
        A view of them.
    """
    exchanged, rows, columns = _orientation(image)
    return (array.swapaxes(0, 1) if exchanged else array)[::rows, ::columns]


def _orientation(image: Image.Image) -> tuple[bool, int, int]:
    upright = (False, 1, 1)
    # Pillow turns TIFF itself. Of PNG, only what is said before the pixels is heeded: to know the
    # rest, all of the file would have to be decoded, for a size as well.
    if image.format == "TIFF" or (image.format == "PNG" and "exif" not in image.info):
        return upright
    try:
        orientation = image.getexif().get(ExifTags.Base.Orientation)
    except Exception:  # as above: broken EXIF data do not make the pixels unreadable
        return upright
    return _ORIENTATIONS.get(orientation, upright) if isinstance(orientation, int) else upright


def _allow_panoramas(most: int) -> None:
    """Raise Pillow's limit, which 16384×8192 exceeds; each file is compared with ours."""
    limit = Image.MAX_IMAGE_PIXELS
    if limit is not None and limit < most:
        Image.MAX_IMAGE_PIXELS = most


def _too_large(path: Path, found: object, most: int) -> DataError:
    return DataError(
        path,
        found=found,
        expected=f"at most {most} pixels",
        remedy=f"Shrink the image; or, if you trust it and have the memory, set {MOST_PIXELS}.",
    )


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno is not None:
        return str(error)
    # Of a file that no decoder knows Pillow says only its name, which the message has already.
    detail = "" if type(error).__name__ == "UnidentifiedImageError" else f" ({error})"
    return f"no image that can be decoded{detail}"
