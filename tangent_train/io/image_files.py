"""Finding and naming image and depth files."""

from __future__ import annotations

import glob
import os
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path, PurePath

from PIL import Image

from tangent_train.errors import DataError
from tangent_train.manifest import MANIFEST

with suppress(ImportError):  # the extra `heif`
    import pillow_heif

    pillow_heif.register_heif_opener()

_FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "GIF", "AVIF", "HEIF")
IMAGE_FORMATS = tuple(sorted({*_FORMATS} & {*Image.registered_extensions().values()}))
"""Pillow's names of the formats that are read; AVIF where Pillow was built with it."""

IMAGE_SUFFIXES = tuple(
    sorted(
        suffix for suffix, name in Image.registered_extensions().items() if name in IMAGE_FORMATS
    )
)
"""Suffixes of images, in lower case."""

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
"""Suffixes of videos, in lower case."""

HEIF_SUFFIXES = (".heic", ".heics", ".heif", ".heifs", ".hif")
"""Suffixes of HEIF images, which are read with the extra ``heif``."""

_OTHER_SUFFIXES = (
    *(".jxl", ".jp2", ".j2k", ".jpx", ".jpf", ".jxr", ".avif", ".insp", ".gpr", ".psd", ".tga"),
    *(".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw"),
    *(".hdr", ".pnm", ".ppm", ".pgm", ".pfm", ".svg", ".ico", ".dds", ".qoi", ".jls", ".pcx"),
)
"""Suffixes of images that are not read: such files are listed, and refused when they are read."""

_SYSTEM_NAMES = {"thumbs.db", "ehthumbs.db", "desktop.ini", "@eadir", "#recycle", "$recycle.bin"}
"""Names in lower case that Windows and network storage write into folders of images."""

_CONVERT = "Convert images of other formats, for example to JPEG or PNG."

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr")
"""Suffixes of depth maps."""

MOST_PIXELS = 32768 * 16384
"""Largest image: a file of a few kilobytes can claim more than memory holds."""


def image_paths(
    pattern: str | Path,
    suffixes: Sequence[str] = IMAGE_SUFFIXES,
    is_result: Callable[[Path], bool] = lambda path: False,
    tell: Callable[[str], object] = lambda text: None,
) -> list[Path]:
    """List the images that a setting names.

    Args:
        pattern: A file; a folder, searched recursively; or a glob pattern, with ``**`` for folders
            of any depth.
        suffixes: Suffixes of images, in lower case.
        is_result: Function that is True for files that a command wrote; they are skipped.
        tell: Called with a message about skipped files of a folder or pattern, if any.

    Returns:
        Sorted paths. From folders and patterns: visible files with one of the suffixes, in lower
        or upper case, and images of formats that are not read.

    Raises:
        DataError: No image was found, or a folder cannot be opened.
    """
    path = Path(pattern)
    if path.is_file() and not is_result(path):
        return [path]
    if path.is_dir():
        named = list(walk_files(path))
    else:
        named = [Path(name) for name in glob.glob(str(path), recursive=True)]  # noqa: PTH207
    # Broken links are kept, so that reading them is an error.
    files = {file for file in named if not file.is_dir() and is_wanted(file, path)}
    found = {file for file in files if not is_result(file)}
    known = {*suffixes, *HEIF_SUFFIXES, *_OTHER_SUFFIXES}
    images = sorted(file for file in found if file.suffix.lower() in known)
    skipped = Counter(file.suffix.lower() or "without suffix" for file in found.difference(images))
    kinds = ", ".join(f"{count} {repr(kind)[1:-1]}" for kind, count in sorted(skipped.items()))
    if not images:
        others = (
            "nothing" if path.exists() or glob.has_magic(str(path)) else "no such file or folder"
        )
        others = f"{len(found)} files, none of them an image: {kinds}" if found else others
        raise DataError(
            pattern,
            found="only results of this command" if files and not found else others,
            expected=f"an image, a folder of images or a pattern such as 'holiday/*.jpg' "
            f"({', '.join(suffixes)})",
            remedy=_CONVERT if skipped else "",
        )
    if skipped:
        tell(f"Skipped: {kinds}. {_CONVERT}")
    return images


def input_paths(
    pattern: str | Path, tell: Callable[[str], object] = lambda text: None
) -> list[Path]:
    """List the images and videos that a command reads, without opening them, see `image_paths`.

    Folders that a command wrote are skipped, unless `pattern` begins with their name.
    """
    begin = Path(pattern)
    if not begin.is_dir():
        begin = next(folder for folder in begin.parents if not glob.has_magic(str(folder)))

    @cache
    def is_written(folder: Path) -> bool:
        inside = begin in folder.parents
        return inside and ((folder / MANIFEST).exists() or is_written(folder.parent))

    suffixes = (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES)
    return image_paths(pattern, suffixes, lambda path: is_written(path.parent), tell)


def is_wanted(path: Path, folder: Path = Path()) -> bool:
    """Return False for hidden files, and for files and folders of an operating system.

    Args:
        path: File or folder.
        folder: Parent folder, or pattern, whose own name may be any.

    >>> [is_wanted(Path(name)) for name in ("a.jpg", ".DS_Store", "Thumbs.db", "@eaDir/a.jpg")]
    [True, False, False, False]
    """
    inside = {part.lower() for part in path.parts} - {part.lower() for part in folder.parts}
    return not any(part.startswith(".") or part in _SYSTEM_NAMES for part in inside)


def glob_files(folder: Path, pattern: str) -> list[Path]:
    """Return the sorted paths below a folder that match a pattern and are wanted."""
    return sorted(path for path in folder.glob(pattern) if is_wanted(path, folder))


def walk_files(folder: Path) -> Iterator[Path]:
    """Yield files of a folder and its subfolders, linked ones included, each folder once.

    Args:
        folder: A folder, which may be missing; only files and folders that are wanted, see
            `is_wanted`.

    Raises:
        DataError: A folder cannot be opened.
    """
    seen = set()
    if not folder.is_dir():
        return
    for parent, folders, names in os.walk(folder, followlinks=True, onerror=_refuse):
        real = os.path.realpath(parent)
        folders[:] = [] if real in seen else [name for name in folders if is_wanted(Path(name))]
        wanted = [] if real in seen else [name for name in names if is_wanted(Path(name))]
        yield from (Path(parent, name) for name in wanted)
        seen.add(real)


def _refuse(error: OSError) -> None:
    expected = "a folder that can be opened"
    raise DataError(error.filename, found=error, expected=expected) from error


def composed(name: str) -> str:
    """Compose the letters of a name (Unicode normalization form NFC).

    Keyboards write "ü" as one character; macOS stores it as "u" and an accent.

    >>> composed("u" + chr(0x308)) == "ü"
    True
    """
    return unicodedata.normalize("NFC", name)


def lower_suffix(name: str) -> str:
    """Return the name of a file with its suffix in lower case.

    >>> lower_suffix("Hall/P1.PNG")
    'Hall/P1.png'
    """
    suffix = PurePath(name).suffix
    return name.removesuffix(suffix) + suffix.lower()


class NamedFiles:
    """Files of a folder and its subfolders by `composed` names; suffixes in lower or upper case.

    Args:
        folder: The folder, which may be missing.

    Raises:
        DataError: A folder cannot be opened.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        files = {composed(p.relative_to(folder).as_posix()): p for p in walk_files(folder)}
        self._found = {lower_suffix(name): path for name, path in files.items()} | files

    def path(self, name: str) -> Path:
        """Return the path of a file, which may be missing; see `composed`.

        Args:
            name: Name of the file relative to the folder.
        """
        name = composed(name)
        return self._found.get(name) or self._found.get(lower_suffix(name), self.folder / name)


def find_depth(files: NamedFiles, name: str, remedy: str) -> Path:
    """Find the depth map of an image.

    Args:
        files: The depth maps.
        name: Path of the image below the folder of images, without suffix. The depth map has the
            same name, or that with ``_depth`` at the end, and one of `DEPTH_SUFFIXES`.
        remedy: Remedy for a missing file.

    Raises:
        DataError: The file is missing, or there are several.
    """
    candidates = [files.path(f"{name}{end}{s}") for end in ("", "_depth") for s in DEPTH_SUFFIXES]
    found = [path for path in candidates if path.is_file()]
    if len(found) != 1:
        raise DataError(
            files.folder / name,
            found=", ".join(path.name for path in found) or "no such file",
            expected="one file of this name, or with _depth at its end, and one of "
            f"{', '.join(DEPTH_SUFFIXES)}",
            remedy="" if found else remedy,
        )
    return found[0]


def short_names(paths: Sequence[Path], pattern: str | Path = "") -> list[str]:
    """Return a name for every image: its path below a folder, without suffix.

    Images that would share a name keep their suffix.

    Args:
        paths: Paths of the images.
        pattern: Argument of `image_paths`. If it is not a folder, the folder is that of all images.

    >>> short_names([Path("a/x/1.jpg"), Path("a/1.jpg"), Path("a/1.png")])
    ['x/1', '1.jpg', '1.png']
    """
    # Without "..", which would lead out of the output folder.
    absolute = [Path(os.path.abspath(path)) for path in paths]  # noqa: PTH100
    if pattern and Path(pattern).is_dir():
        folder = os.path.abspath(pattern)  # noqa: PTH100
    else:
        folder = os.path.commonpath([path.parent for path in absolute])
    shared = len(Path(folder).parts)
    whole = [Path(*path.parts[shared:]) for path in absolute]
    short = [path.with_suffix("") for path in whole]
    # Upper and lower case are the same file on some disks; "1.jpg.png" without suffix is "1.jpg".
    taken = Counter(str(path).casefold() for path in (*short, *whole))
    chosen = zip(whole, short, strict=True)
    return [(a if taken[str(b).casefold()] > 1 else b).as_posix() for a, b in chosen]
