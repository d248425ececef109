"""Finding and naming the user's own images and depth maps."""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from tangent_train.errors import DataError

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp")
"""Suffixes of images, in lower case."""

DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy", ".exr")
"""Suffixes of depth maps."""


def image_paths(pattern: str | Path, suffixes: Sequence[str] = IMAGE_SUFFIXES) -> list[Path]:
    """The images that a setting names.

    Args:
        pattern: A file; a folder, searched recursively; or a glob pattern, with ``**`` for folders
            of any depth.
        suffixes: Of images, in lower case.

    Returns:
        Sorted paths. Of folders and patterns only files with one of the suffixes, in lower or upper
        case, that are not hidden.

    Raises:
        DataError: There are none, or a folder cannot be opened.
    """
    path = Path(pattern)
    if path.is_file():
        return [path]
    if path.is_dir():
        found = list(walk_files(path))
    else:
        found = [Path(name) for name in glob.glob(str(path), recursive=True)]  # noqa: PTH207
    images = sorted({file for file in found if file.suffix.lower() in suffixes})
    # Links that lead nowhere stay: whoever reads them says so.
    images = [file for file in images if not file.is_dir() and not file.name.startswith(".")]
    if not images:
        raise DataError(
            pattern,
            found=f"{len(found)} files, none of them an image" if found else "nothing",
            expected=f"an image, a folder of images or a pattern such as 'holiday/*.jpg' "
            f"({', '.join(suffixes)})",
        )
    return images


def walk_files(folder: Path) -> Iterator[Path]:
    """Files of a folder and its subfolders, linked ones included, each folder once.

    Args:
        folder: There or not; hidden files and folders are left out.

    Raises:
        DataError: A folder cannot be opened.
    """
    seen = set()
    if not folder.is_dir():
        return
    for parent, folders, names in os.walk(folder, followlinks=True, onerror=_refuse):
        real = os.path.realpath(parent)
        folders[:] = [] if real in seen else [name for name in folders if name[0] != "."]
        yield from (Path(parent, name) for name in names if real not in seen and name[0] != ".")
        seen.add(real)


def _refuse(error: OSError) -> None:
    expected = "a folder that can be opened"
    raise DataError(error.filename, found=error, expected=expected) from error


def find_depth(folder: Path, name: str, remedy: str) -> Path:
    """The depth map of an image.

    Args:
        folder: Of the depth maps.
        name: Path of the image below the folder of images, without suffix. The depth map has the
            same name, or that with ``_depth`` at the end, and one of `DEPTH_SUFFIXES`.
        remedy: Remedy if there is none.

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


def short_names(paths: Sequence[Path]) -> list[str]:
    """A name for every image: its path below the folder all are in, without suffix.

    Images that would share a name keep their suffix.

    >>> short_names([Path("a/x/1.jpg"), Path("a/1.jpg"), Path("a/1.png")])
    ['x/1', '1.jpg', '1.png']
    """
    # Without "..", which would lead out of the output folder.
    absolute = [Path(os.path.abspath(path)) for path in paths]  # noqa: PTH100
    shared = len(Path(os.path.commonpath([path.parent for path in absolute])).parts)
    whole = [Path(*path.parts[shared:]) for path in absolute]
    short = [path.with_suffix("") for path in whole]
    # Upper and lower case are the same file on some disks; "1.jpg.png" without suffix is "1.jpg".
    taken = Counter(str(path).casefold() for path in (*short, *whole))
    chosen = zip(whole, short, strict=True)
    return [(a if taken[str(b).casefold()] > 1 else b).as_posix() for a, b in chosen]
