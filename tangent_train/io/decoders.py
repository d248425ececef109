"""Decode images that Pillow opens: whole files only, and their colors in sRGB."""

from __future__ import annotations

import warnings
from functools import lru_cache
from io import BytesIO
from typing import IO, Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL import Image, ImageCms

from tangent_train.errors import first_line

_SRGB = ImageCms.createProfile("sRGB")
_INTENT = ImageCms.Intent.RELATIVE_COLORIMETRIC
_COLOR_STEPS = np.arange(0, 256, 17, dtype=np.uint8)
_DAMAGE = ("Corrupt JPEG data", "Premature end of JPEG file")
"""Beginnings of libjpeg's warnings about damage; others are about odd headers."""

_LOST = 256  # zero bytes at the end: part of a file that was never copied


def load_whole(image: Image.Image, file: IO[bytes]) -> Image.Image | NDArray[np.uint8]:
    """Decode the pixels of an image; refuse damage that Pillow does not notice.

    Pillow ignores libjpeg's warnings, the checksums of PNG, and the padding of AV1 data. JPEG is
    decoded by simplejpeg, which is faster too, and AVIF by OpenCV with libaom.

    Args:
        image: Image that Pillow opened.
        file: Its file.

    Returns:
        The decoded image; gray and RGB pixels of JPEG and AVIF as an array.

    Raises:
        ValueError: The image is damaged; the decoders raise other errors too.
    """
    file.seek(0)
    if image.format in ("JPEG", "MPO"):
        return _decode_jpeg(image, file.read())
    if image.format == "AVIF":
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        pixels = decode_by_opencv(file, flags)
        if image.mode == "RGB":  # OpenCV blends colors with transparency
            return pixels
    elif image.format == "PNG":
        Image.open(file, formats=["PNG"]).verify()
    elif image.format in ("WEBP", "HEIF") and not any(file.read()[-_LOST:]):
        raise ValueError("zeros at the end of the file")
    image.load()
    return image


def _decode_jpeg(image: Any, content: bytes) -> Image.Image | NDArray[np.uint8]:
    rawmode = image.tile[0][3][0]
    try:
        pixels = simplejpeg.decode_jpeg(content, "GRAY" if image.mode == "L" else image.mode)
    except ValueError as error:
        if str(error).startswith(_DAMAGE):
            raise
        image.load()
        return image
    if image.mode != "CMYK":
        return np.asarray(pixels[..., 0] if image.mode == "L" else pixels)
    inks = Image.frombuffer("CMYK", image.size, pixels, "raw", rawmode, 0, 1)
    inks.info = image.info
    return inks


def decode_by_opencv(file: IO[bytes], flags: int) -> NDArray[Any]:
    """Decode a file that OpenCV reads.

    Args:
        file: An image.
        flags: Flags of `cv2.imdecode`.

    Raises:
        ValueError: The image is damaged.
    """
    # From memory: `cv2.imread` cannot open paths beyond the system's code page.
    file.seek(0)
    pixels: Any = cv2.imdecode(np.frombuffer(file.read(), np.uint8), flags)
    if pixels is None:
        raise ValueError("damaged data")
    return pixels


def to_srgb(image: Image.Image, profile: bytes | None, subject: object) -> Image.Image:
    """Convert colors by an ICC profile to sRGB, as image viewers do.

    Args:
        image: Gray, RGB or CMYK image of 8 bits; others are returned unchanged.
        profile: Embedded profile. Of a profile that cannot be used, a warning is given.
        subject: Name of the image in the warning.
    """
    if not profile or image.mode not in ("L", "RGB", "CMYK"):
        return image
    try:
        mode, transform = _transform(profile, image.mode)
        image = image if image.mode == mode else image.convert(mode)
        return image if transform is None else transform.apply(image)
    except (ImageCms.PyCMSError, ValueError, OSError) as error:
        warnings.warn(
            f"{subject}: found a color profile that cannot be used ({first_line(error)}); its "
            "colors are read as sRGB.",
            stacklevel=2,
        )
        return image


def deep_to_srgb(pixels: NDArray[np.uint16], profile: bytes, subject: object) -> NDArray[np.uint16]:
    """Convert colors of 16 bits as `to_srgb`, by interpolation between colors of 8 bits."""
    low, rest = np.divmod(pixels, 257)  # 65535 = 255 · 257
    eight = Image.fromarray(low.astype(np.uint8))
    converted = to_srgb(eight, profile, subject)
    if converted is eight:
        return pixels
    base = result = np.array(converted, np.float32)
    for channel in np.eye(pixels.shape[2], dtype=np.uint8) if pixels.ndim == 3 else [np.uint8(1)]:
        above = Image.fromarray(np.minimum(low + channel, 255).astype(np.uint8))
        share = (rest * channel).max(axis=-1) if pixels.ndim == 3 else rest
        step = np.asarray(to_srgb(above, profile, subject)) - base
        result = result + step * (share / np.float32(257))[..., None]
    return np.rint(result * 257).clip(0, 65535).astype(np.uint16)


@lru_cache(maxsize=16)
def _transform(profile: bytes, mode: str) -> tuple[str, ImageCms.ImageCmsTransform | None]:
    """Return the mode and the transform to sRGB; None if it changes no color by over a level."""
    source = ImageCms.ImageCmsProfile(BytesIO(profile))
    if mode == "L" and source.profile.xcolor_space.strip() == "RGB":
        mode = "RGB"
    transform = ImageCms.buildTransform(source, _SRGB, mode, "RGB", _INTENT)
    if mode == "RGB":
        colors = np.stack(np.meshgrid(*3 * [_COLOR_STEPS]), axis=-1).reshape(-1, 16, 3)
        changed = np.asarray(transform.apply(Image.fromarray(colors)), np.int16)
        if np.abs(changed - colors).max() <= 1:
            return mode, None
    return mode, transform
