"""The files of SYNTHIA's video sequences and of OmniSYNTHIA: names, partners, cameras.

On disk, as released (`0X` is 01, 02, 04, 05 or 06)::

    root/SYNTHIA-SEQS-0X-SUMMER/
      RGB/Stereo_Left/Omni_F/000000.png        760×1280, 8 bit; Omni_R, Omni_B, Omni_L likewise
      GT/LABELS/Stereo_Left/Omni_F/000000.png  16-bit RGB: R is the class, the others the instance
      Depth/Stereo_Left/Omni_F/000000.png      16 bit, z-depth in cm, in every channel there is
      CameraParams/intrinsics.txt              focal length, centre x and y, baseline; or a matrix
      pano/                                    OmniSYNTHIA: 2096×4192
        RGB/000000.png                         8 bit, black where no view looks
        GT/LABELS_Correct/000000.png           8 bit, 255 where no view looks
        Depth/000000.png                       16 bit, cm

The four views of a frame are upright and share their centre: F looks ahead and each of R, B, L a
quarter turn further to the right.
"""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from datamodules.core.problems import Noted, raised
from datamodules.images.png import check_png
from tangent_train.errors import DataError

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray


__all__ = [
    "GET_IT",
    "PANORAMA_FORMATS",
    "VIEWS",
    "VIEW_FORMATS",
    "PictureFiles",
    "check_files",
    "check_root",
    "list_frames",
    "list_panoramas",
    "panorama_files",
    "read_camera",
    "sequence_folder",
    "view_files",
    "views_folder",
]

VIEWS: tuple[str, ...] = ("F", "R", "B", "L")
"""Front, right, back, left: each looks a quarter turn to the right of the one before."""

GET_IT = (
    "Get SYNTHIA-SEQS-01, -02, -04, -05 and -06 SUMMER from http://synthia-dataset.net and point "
    "data.root at the folder that holds them."
)
"""What to do when the data set is not there."""

Formats = dict[str, tuple[int, tuple[str, ...]]]
"""Bits and colour types by part."""

VIEW_FORMATS: Formats = {
    "rgb": (8, ("RGB", "RGBA")),
    "labels": (16, ("RGB", "RGBA")),
    "depth": (16, ("grey", "RGB", "RGBA")),
}
"""Pixel formats of a view."""

PANORAMA_FORMATS: Formats = {
    "rgb": (8, ("RGB", "RGBA")),
    "labels": (8, ("grey",)),
    "depth": (16, ("grey",)),
}
"""Pixel formats of a panorama."""

_SIZE = (760, 1280)
_FOCAL, _CENTER = 532.740352, (640.0, 380.0)  # of images of that size, centre from pixel corners
_NAME = "[0-9]" * 6 + ".png"


class PictureFiles(NamedTuple):
    """The files of one view or panorama."""

    rgb: Path
    labels: Path
    depth: Path | None

    @property
    def parts(self) -> Mapping[str, Path]:
        """Those there are, by name."""
        return {part: path for part, path in self._asdict().items() if path is not None}


# --- names ------------------------------------------------------------------------------------


def sequence_folder(root: Path, sequence: str) -> Path:
    """Folder of a sequence.

    >>> from pathlib import Path
    >>> sequence_folder(Path("synthia"), "01").name
    'SYNTHIA-SEQS-01-SUMMER'
    """
    return root / f"SYNTHIA-SEQS-{sequence}-SUMMER"


def views_folder(folder: Path, view: str) -> Path:
    """Folder of the colour images of one of `VIEWS` of the sequence in `folder`."""
    return folder / "RGB" / "Stereo_Left" / f"Omni_{view}"


def view_files(folder: Path, view: str, frame: str, *, with_depth: bool) -> PictureFiles:
    """Files of one view of the sequence in `folder`; `frame` is as ``000000``."""
    place = f"Stereo_Left/Omni_{view}/{frame}.png"
    depth = folder / "Depth" / place if with_depth else None
    return PictureFiles(folder / "RGB" / place, folder / "GT" / "LABELS" / place, depth)


def panorama_files(folder: Path, frame: str, *, with_depth: bool) -> PictureFiles:
    """Files of one panorama of the sequence in `folder`; `frame` is as ``000000``."""
    pano, name = folder / "pano", f"{frame}.png"
    depth = pano / "Depth" / name if with_depth else None
    return PictureFiles(pano / "RGB" / name, pano / "GT" / "LABELS_Correct" / name, depth)


def list_frames(folder: Path) -> list[str]:
    """Frames of which a view has a colour image, as ``000000``, in order; none is no error."""
    return _names(*(views_folder(folder, view) for view in VIEWS))


def list_panoramas(folder: Path) -> list[str]:
    """Frames that have the colour image of a panorama, in order; none is no error."""
    return _names(folder / "pano" / "RGB")


def _names(*folders: Path) -> list[str]:
    paths = (path for folder in folders for path in _listed(folder))
    return sorted({path.stem for path in paths if path.match(_NAME)})


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except FileNotFoundError:
        return []
    except OSError as error:
        raise DataError(
            folder, found=os.strerror(error.errno or 0), expected="a folder of images"
        ) from error


# --- what the headers tell -----------------------------------------------------------------------


def check_root(root: Path) -> None:
    """Make sure that the folder of the data set is there.

    Raises:
        DataError: It is not.
    """
    if not root.is_dir():
        raise DataError(root, found="no such folder", expected="the data set", remedy=GET_IT)


def check_files(
    files: PictureFiles, formats: Formats, noted: Noted = raised, item: Hashable = None
) -> tuple[int, int]:
    """Check that all files are there, whole, of one size and as released; nothing is decoded.

    Args:
        files: Of one view or panorama.
        formats: `VIEW_FORMATS` or `PANORAMA_FORMATS`.
        noted: Where errors go, to go on after them.
        item: What they are noted of.

    Returns:
        Rows and columns; (0, 0) of none that could be read.

    Raises:
        DataError: A file is missing, cut off, or of another size or pixel format.
    """
    size = None
    for part, path in files.parts.items():
        with noted(item):
            header = check_png(path, *formats[part])
            size = size or (header.height, header.width)
            if (header.height, header.width) != size:
                raise DataError(
                    path,
                    found=f"{header.height}×{header.width} pixels",
                    expected=f"{size[0]}×{size[1]}, as {files.rgb}",
                    remedy="Copy or extract both files again.",
                )
    return size or (0, 0)


# --- cameras -------------------------------------------------------------------------------------


def read_camera(folder: Path, size: tuple[int, int]) -> NDArray[np.float64]:
    """Camera matrix of all views of a sequence.

    From ``CameraParams/intrinsics.txt``: the focal length, x and y of the centre, and perhaps the
    baseline; or the matrix. Without that file, the one camera of the release.

    Args:
        folder: Of the sequence.
        size: Rows and columns of the views.

    Returns:
        ``(3, 3)`` K for integer pixel centres; the file counts from pixel corners.

    Raises:
        DataError: The file holds something else, or is missing and the views have another size.
    """
    path = folder / "CameraParams" / "intrinsics.txt"
    if path.exists():
        focal, center = _parse_camera(path, size)
    elif size == _SIZE:
        focal, center = (_FOCAL, _FOCAL), _CENTER
    else:
        raise DataError(
            path,
            found=f"no such file, and views of {size[0]}×{size[1]} pixels",
            expected=f"the file, or views of {_SIZE[0]}×{_SIZE[1]}, whose camera is known",
            remedy="Write focal length, centre x and centre y in pixels to this file.",
        )
    return np.array([[focal[0], 0, center[0] - 0.5], [0, focal[1], center[1] - 0.5], [0, 0, 1]])


def _parse_camera(
    path: Path, size: tuple[int, int]
) -> tuple[tuple[float, float], tuple[float, float]]:
    text = path.read_text(encoding="utf-8", errors="replace")
    try:
        numbers = [float(number) for number in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) in (3, 4):  # with the baseline or without
        f, x, y = numbers[:3]
        numbers = [f, 0, x, 0, f, y, 0, 0, 1]
    if len(numbers) == 9 and all(map(math.isfinite, numbers)):
        fx, skew, x, zero, fy, y, *last = numbers
        plain = skew == 0 and zero == 0 and last == [0, 0, 1]
        if plain and fx > 0 and fy > 0 and 0 < x < size[1] and 0 < y < size[0]:
            return (fx, fy), (x, y)
    raise DataError(
        path,
        found=repr(text[:80]),
        expected="focal length, centre x and y (and baseline), or a 3×3 camera matrix, in pixels "
        f"of views of {size[0]}×{size[1]}",
        remedy="Extract the file again; without it the camera of the release is used.",
    )
