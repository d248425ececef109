"""The files of one's own data set: a folder of images, one of labels, perhaps one of depth."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from datamodules.core.problems import Noted, raised
from datamodules.images.image_files import find_depth, find_images
from datamodules.images.pixel_files import read_image_size, read_pixels, read_rgb
from datamodules.images.png import PngHeader, check_panorama_size, read_png_header
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from datamodules.folder.classes import FolderClasses

__all__ = [
    "PanoramaFiles",
    "check_class_codes",
    "check_panorama",
    "list_panoramas",
    "read_codes",
]

_LAYOUT = "images/, labels/ and classes.json, see docs/own_data.md"
_TRIED = 4
# What label images may be. In grey of 1 to 4 bits the numbers may be meant, or the steps from black
# to white that they stand for: better asked than guessed. 16 bits beside alpha are not decoded.
_VALUES = ("8-bit grey", "16-bit grey", "8-bit grey with alpha", "palette")
_WITHOUT = "Or train without depth: data.inputs=[rgb]."
_COLORS = ("8-bit RGB", "8-bit RGBA", "8-bit grey", "8-bit grey with alpha", "palette")


class PanoramaFiles(NamedTuple):
    """The files of one panorama.

    Attributes:
        name: Path of the image in ``images/`` without ending, with ``/`` between folders.
        rgb: The image.
        labels: Its classes.
        depth: Its depth, if wanted.
    """

    name: str
    rgb: Path
    labels: Path
    depth: Path | None

    @property
    def scene(self) -> str:
        """The first folder of the name; the name itself of an image that is in none."""
        return self.name.partition("/")[0]

    @property
    def parts(self) -> dict[str, Path]:
        """All files by what they hold."""
        depth = {} if self.depth is None else {"depth": self.depth}
        return {"rgb": self.rgb, "labels": self.labels, **depth}


def list_panoramas(root: Path, *, with_depth: bool, noted: Noted = raised) -> list[PanoramaFiles]:
    """All panoramas of a data set, in the order of their names.

    Args:
        root: Folder with ``images/`` and ``labels/``.
        with_depth: Whether depth is wanted.
        noted: Where errors go, to go on after them: those of a panorama under its name.

    Raises:
        DataError: A folder is missing or there are no images, two have one name, or a panorama has
            no depth, or several.
    """
    for folder in (root, root / "images", root / "labels"):
        if not folder.is_dir():
            raise DataError(folder, found="no such folder", expected=f"a data set: {_LAYOUT}")
    found: dict[str, PanoramaFiles] = {}
    for rgb in find_images(root / "images", noted):
        name = rgb.relative_to(root / "images").with_suffix("").as_posix()
        labels, depth = root / "labels" / f"{name}.png", None
        with noted(name):
            if name in found:
                raise DataError(
                    rgb,
                    found=f"{found[name].rgb.name} beside it",
                    expected="one image of each name: its labels have the same one",
                    remedy="Rename or remove one of them.",
                )
        with noted(name):
            depth = find_depth(root / "depth", name, _WITHOUT) if with_depth else None
        found.setdefault(name, PanoramaFiles(name, rgb, labels, depth))
    return [found[name] for name in sorted(found)]


def check_panorama(
    files: PanoramaFiles, erp_height: int, *, in_colors: bool, noted: Noted = raised
) -> None:
    """Check that all files are there, of one size and readable at `erp_height`; nothing is decoded.

    Args:
        files: Of the panorama.
        erp_height: Rows that are wanted.
        in_colors: Whether classes are told by colours, not values.
        noted: Where errors go, to go on after them, under the panorama's name.

    Raises:
        DataError: A file is missing, cut off, or of another size or kind.
        SettingError: The panorama has fewer rows than wanted.
    """
    size = None
    with noted(files.name, files.rgb):
        size = read_image_size(files.rgb)
        check_panorama_size(files.rgb, size, erp_height)
    with noted(files.name):
        header = read_png_header(files.labels)
        _check_kind(files.labels, header, in_colors=in_colors)
        _check_size(files.labels, (header.height, header.width), files.rgb, size)
    with noted(files.name):
        if files.depth is not None:
            _check_size(files.depth, read_image_size(files.depth), files.rgb, size)


def _check_kind(path: Path, header: PngHeader, *, in_colors: bool) -> None:
    kind = f"{header.bits}-bit {header.color}"
    allowed = _COLORS if in_colors else _VALUES
    if kind not in allowed and header.color not in allowed:
        raise DataError(
            path,
            found=kind,
            expected=f"{', '.join(allowed)}: "
            f"classes.json names {'colours' if in_colors else 'values'}",
            remedy="Convert the labels, or say in classes.json what they hold.",
        )


def _check_size(
    path: Path, size: tuple[int, int], rgb: Path, expected: tuple[int, int] | None
) -> None:
    if expected is not None and size != expected:
        raise DataError(
            path,
            found=f"{size[0]}×{size[1]} pixels",
            expected=f"{expected[0]}×{expected[1]}, as {rgb}",
            remedy="Export both at one size.",
        )


def read_codes(path: Path, *, in_colors: bool) -> NDArray[np.integer]:
    """Decode a label image.

    Args:
        path: The PNG.
        in_colors: Whether classes are told by colours, not values. Of palettes, values are the
            numbers of the entries.

    Returns:
        ``(H, W)`` values, or ``(H, W, 3)`` colours; transparency is left out.

    Raises:
        DataError: The file is broken.
    """
    return read_rgb(path) if in_colors else read_pixels(path, indices=True)


def check_class_codes(
    panoramas: list[PanoramaFiles], classes: FolderClasses, noted: Noted = raised
) -> None:
    """Make sure that the class list is that of the label images, by the first few of them.

    Args:
        panoramas: Those that may be read.
        classes: The list.
        noted: Where broken files go, to go on after them, under the panorama's name.

    Raises:
        DataError: None of their pixels has a class, or a file is broken.
    """
    seen: set[int] = set()
    for files in panoramas[:_TRIED]:
        with noted(files.name):
            stored = read_codes(files.labels, in_colors=classes.in_colors)
            if classes.decode(stored).any():
                return
            seen |= set(np.unique(classes.pack(stored)).tolist())
    if not seen:
        return
    raise DataError(
        panoramas[0].labels,
        found=f"{classes.describe(np.array(sorted(seen), np.int32))}, in this file and the next",
        expected=f"{classes.describe(classes.codes)}, as classes.json says",
        remedy="Correct classes.json: no pixel would have a class.",
    )
