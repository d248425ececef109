"""People's own images: finding them, and reading colours and depth from any usual format."""

from __future__ import annotations

import glob
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import ExifTags

from datamodules.core.links import note_links
from datamodules.images.exr import read_exr, read_exr_size
from datamodules.images.image_opening import open_image, oriented_array, oriented_size
from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray
    from PIL import Image

    from datamodules.core.problems import Noted

__all__ = [
    "DEPTH_SUFFIXES",
    "IMAGE_SUFFIXES",
    "find_depth",
    "find_images",
    "photo_fov_deg",
    "read_array",
    "read_depth_m",
    "read_depth_size",
    "read_image_size",
    "read_rgb",
]

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
"""What names of images end in, in lower case."""

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr")
"""What names of depth files end in."""

_BAND_ROWS = 256
_MOST_M = 1e4  # what lies farther marks missing depth: some files have 1e10 there
_MISSING_UNITS = 65535
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_DEPTH = "16-bit grey PNG or TIFF, 32-bit float TIFF, .npy or .exr"


def find_images(pattern: str | Path, noted: Noted | None = None) -> list[Path]:
    """The images that a setting names.

    Args:
        pattern: A file; a folder, which is searched with all its folders; or a pattern with ``*``,
            ``?``, ``[…]`` and, for folders of any depth, ``**``. A file or folder whose own name
            holds such characters is that file. ``~`` is the home folder.
        noted: Where what is passed over goes: folders that cannot be opened, links that lead
            nowhere or in a circle.

    Returns:
        In the order of their paths. Of folders and patterns only those whose names end in one of
        `IMAGE_SUFFIXES`, in lower or upper case, and do not begin with a dot.

    Raises:
        DataError: There are none.
    """
    path = Path(pattern)
    # The shell leaves the ~ of "input=~/holiday" alone.
    path = path.expanduser() if path.parts[:1] == ("~",) else path
    if path.is_file():
        return [path]
    if path.is_dir():
        found = list(_walk(path, noted))
    else:
        found = [Path(name) for name in glob.glob(str(path), recursive=True)]  # noqa: PTH207
    images = sorted({file for file in found if file.suffix.lower() in IMAGE_SUFFIXES})
    images = [file for file in images if file.is_file() and not file.name.startswith(".")]
    if not images:
        raise DataError(
            pattern,
            found=f"{len(found)} files, none of them an image" if found else "nothing",
            expected=f"an image, a folder of images or a pattern such as 'holiday/*.jpg' "
            f"({', '.join(IMAGE_SUFFIXES)})",
        )
    return images


def _walk(folder: Path, noted: Noted | None) -> Iterator[Path]:
    """The files of a folder and its folders, linked ones as well, each once, but hidden ones."""
    seen = set()

    def closed(error: OSError) -> None:
        if noted is not None:
            with noted(Path(error.filename)):
                raise error

    for parent, folders, names in os.walk(folder, followlinks=True, onerror=closed):
        real = os.path.realpath(parent)
        folders[:] = [] if real in seen else [name for name in folders if name[0] != "."]
        if noted is not None:
            passed_over = note_links(Path(parent), (*folders, *names), noted)
            folders[:] = [name for name in folders if name not in passed_over]
        yield from (Path(parent, name) for name in names if real not in seen and name[0] != ".")
        seen.add(real)


def read_image_size(path: Path) -> tuple[int, int]:
    """Rows and columns that `read_rgb` gives, from the header of the file.

    Args:
        path: JPEG, PNG, TIFF or WebP.

    Raises:
        DataError: It cannot be read, or is no image.
    """
    with open_image(path) as image:
        return oriented_size(image)


def read_rgb(path: Path) -> NDArray[np.uint8]:
    """Decode the colours of an image.

    16 bits per channel become 8 by leaving out the lower ones; grey becomes three equal channels;
    transparency is left out. The image is turned as its EXIF orientation says.

    Args:
        path: JPEG, PNG, TIFF or WebP.

    Returns:
        ``(H, W, 3)``.

    Raises:
        DataError: The file cannot be read, is broken, or holds other values than colours.
    """
    with open_image(path) as image:
        if image.mode in ("I", "F"):
            raise DataError(
                path,
                found=f"32-bit {'numbers' if image.mode == 'I' else 'floats'}",
                expected="colours of 8 or 16 bits",
                remedy="Export the image as JPEG or PNG.",
            )
        image.load()
        # Dropped here: Pillow would warn that the colours of a palette lose it.
        image.info.pop("transparency", None)
        stored = np.empty((image.height, image.width, 3), np.uint8)
        # In bands: an image of 8192×4096 converted at once takes three times its memory.
        for top in range(0, image.height, _BAND_ROWS):
            rows = slice(top, min(top + _BAND_ROWS, image.height))
            stored[rows] = _colors(image.crop((0, rows.start, image.width, rows.stop)))
        return np.ascontiguousarray(oriented_array(stored, image))


def _colors(band: Image.Image) -> NDArray[np.uint8]:
    """Any Pillow image as something that fits into ``(H, W, 3)``."""
    if band.mode.startswith("I;16"):
        return (np.asarray(band) >> 8).astype(np.uint8)[..., None]
    return np.asarray(band.convert("RGB"))


def photo_fov_deg(path: Path) -> float | None:
    """Horizontal field of view of a photo, as its EXIF data say.

    They give the focal length of the camera that would see as much on 36×24 mm film. As much is
    meant along the diagonal (CIPA DCG-001), so other aspect ratios and upright photos are right
    too; of a photo that was cut afterwards it is not.

    Args:
        path: The photo.

    Returns:
        Degrees, or None where nothing is said.

    Raises:
        DataError: The file cannot be read, or is no image.
    """
    with open_image(path) as image:
        height, width = oriented_size(image)
        try:
            exif = image.getexif().get_ifd(ExifTags.IFD.Exif)
            film_mm = float(exif.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
        except Exception:  # broken EXIF data say nothing; their reader raises many kinds of errors
            return None
    if not 0 < film_mm < math.inf:  # 0 stands for unknown
        return None
    focal_pixels = film_mm / _FILM_DIAGONAL_MM * math.hypot(height, width)
    return math.degrees(2 * math.atan(width / (2 * focal_pixels)))


def read_depth_m(path: Path, units_per_m: float) -> NDArray[np.float32]:
    """Read a depth image.

    Args:
        path: PNG, TIFF or NumPy array of whole numbers, which are units; or TIFF, NumPy array or
            OpenEXR image of floats, which are metres. Of several channels of OpenEXR the one called
            Z, Y, V or R.
        units_per_m: Units in a metre, 1000 for millimetres.

    Returns:
        ``(H, W)`` metres; 0 where depth is missing: where the file has 0 or less, NaN, infinity,
        more than 10 km or, of 16-bit numbers, 65535.

    Raises:
        DataError: The file cannot be read, is broken, or holds no depth.
        SettingError: The units are not more than 0.
    """
    if not 0 < units_per_m < math.inf:
        raise SettingError("depth units per metre", found=units_per_m, expected="more than 0")
    stored = _DEPTH_READERS.get(path.suffix.lower(), _read_depth_image)(path)
    if stored.ndim != 2 or stored.dtype.kind not in "uif":
        raise DataError(
            path, found=f"{stored.dtype} of shape {stored.shape}", expected=f"depth: {_DEPTH}"
        )
    depth = stored.astype(np.float32)
    if stored.dtype.kind != "f":
        depth /= np.float32(units_per_m)
    missing = ~((depth > 0) & (depth <= _MOST_M))
    if stored.dtype == np.uint16:
        missing |= stored == _MISSING_UNITS
    depth[missing] = 0
    return depth


def read_depth_size(path: Path) -> tuple[int, int]:
    """Rows and columns that `read_depth_m` gives, from the header of the file.

    Args:
        path: As there.

    Raises:
        DataError: The file cannot be read, or is no image.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        return read_exr_size(path)
    if suffix == ".npy":
        shape = read_array(path, mapped=True).shape
        return (shape[0], shape[1]) if len(shape) > 1 else (0, 0)
    return read_image_size(path)


def _read_depth_image(path: Path) -> NDArray[Any]:
    with open_image(path) as image:
        if image.mode not in ("I", "F") and not image.mode.startswith("I;16"):
            raise DataError(
                path,
                found=f"an image of {'8 bits' if image.mode == 'L' else image.mode}",
                expected=f"depth: {_DEPTH}",
            )
        stored = oriented_array(np.asarray(image), image)
        # Big-endian files are compared and divided like all others.
        return stored.astype(stored.dtype.newbyteorder("="))


def read_array(path: Path, *, mapped: bool = False) -> NDArray[Any]:
    """Read a ``.npy`` file.

    Args:
        path: The file.
        mapped: Whether the pixels stay in it until they are used; not to be written to then.

    Returns:
        What it holds; of ``(H, W, 1)`` without the last dimension.

    Raises:
        DataError: It cannot be read, or is no array of NumPy's.
    """
    try:
        with np.errstate(over="ignore"):  # by the sizes in a broken header
            array = np.load(path, mmap_mode="r" if mapped else None, allow_pickle=False)
    # Broken headers raise anything, tokenize.TokenError and MemoryError as well.
    except Exception as error:
        raise DataError(
            path, found=error, expected="a NumPy array of numbers", remedy="Save it again."
        ) from error
    if not isinstance(array, np.ndarray):  # an archive of arrays
        array.close()
        raise DataError(path, found="a .npz archive", expected="one array, saved with numpy.save")
    return array[..., 0] if array.ndim == 3 and array.shape[-1] == 1 else array


_DEPTH_READERS = {".npy": read_array, ".exr": read_exr}


def find_depth(folder: Path, name: str, remedy: str) -> Path:
    """The depth image that belongs to an image.

    Args:
        folder: Of the depth images.
        name: Path of the image below the folder of the images, without suffix. The depth image has
            the same, perhaps with ``_depth`` at the end, and one of `DEPTH_SUFFIXES`.
        remedy: What to do where there is none.

    Raises:
        DataError: There is none, or there are several.
    """
    candidates = [folder / f"{name}{end}{s}" for end in ("", "_depth") for s in DEPTH_SUFFIXES]
    found = [path for path in candidates if path.is_file()]
    if len(found) != 1:
        raise DataError(
            folder / name,
            found=", ".join(path.name for path in found) or "no such file",
            expected="one file of this name, or with _depth at its end, and one of "
            f"{', '.join(DEPTH_SUFFIXES)}",
            remedy="" if found else remedy,
        )
    return found[0]
