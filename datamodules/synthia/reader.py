"""Files of SYNTHIA's video sequences and of OmniSYNTHIA: names, cameras, labels, depth.

On disk, as released (`0X` is 01, 02, 04, 05 or 06)::

    root/SYNTHIA-SEQS-0X-SUMMER/
      RGB/Stereo_Left/Omni_F/000000.png        760×1280, 8 bit; and Omni_R, Omni_B, Omni_L
      GT/LABELS/Stereo_Left/Omni_F/000000.png  16-bit RGB: R is the class, the others the instance
      Depth/Stereo_Left/Omni_F/000000.png      16 bit, z-depth in cm, in every channel there is
      CameraParams/intrinsics.txt              focal length, center x and y, baseline
      pano/                                    OmniSYNTHIA: 2096×4192
        RGB/000000.png                         8 bit, black outside the views
        GT/LABELS_Correct/000000.png           8 bit, 255 outside the views
        Depth/000000.png                       16 bit, cm

The four views of a frame are upright and share their center: F faces forward, and R, B and L are
each rotated by a further 90° to the right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.core.files import ImageFiles
from tangent_train.io.pixel_files import read_pixels

VIEWS: tuple[str, ...] = ("F", "R", "B", "L")
"""Front, right, back, left: each rotated by 90° to the right of the previous one."""

GET_IT = "Get SYNTHIA-SEQS-01, -02, -04, -05 and -06 SUMMER from http://synthia-dataset.net."
"""Remedy if the data set is missing."""

FRAMES = 500
"""Approximate number of frames of each sequence in OmniSYNTHIA."""

_SIZE = (760, 1280)
_CAMERA = "532.740352 640 380"  # of views of that size, center from pixel corners
_NAME = "[0-9]" * 6 + ".png"

CLASSES: tuple[str, ...] = (
    *("sky", "building", "road", "sidewalk", "fence", "vegetation", "pole", "car"),
    *("traffic sign", "pedestrian", "bicycle", "lane marking", "traffic light"),
)
"""The classes as labels 1 to 13. In the files traffic lights are 15; 13 and 14 are reserved."""

INVALID = 255
"""Label in panoramas for pixels outside of all views."""


def sequence_folder(root: Path, sequence: str) -> Path:
    """Return the folder of a sequence.

    >>> from pathlib import Path
    >>> sequence_folder(Path("."), "01").name
    'SYNTHIA-SEQS-01-SUMMER'
    """
    return root / f"SYNTHIA-SEQS-{sequence}-SUMMER"


def view_files(folder: Path, frame: str, view: str) -> ImageFiles:
    """Return the files of one of `VIEWS` of a frame, e.g. ``000000``, of a sequence."""
    place = f"Stereo_Left/Omni_{view}/{frame}.png"
    camera = _camera_file(folder)
    return ImageFiles(
        f"{_title(folder)}/{frame}/{view}",
        folder / "RGB" / place,
        folder / "GT" / "LABELS" / place,
        folder / "Depth" / place,
        camera if camera.exists() else None,
    )


def panorama_files(folder: Path, frame: str) -> ImageFiles:
    """Return the files of the panorama of a frame, e.g. ``000000``, of a sequence."""
    pano, name = folder / "pano", f"{frame}.png"
    labels = pano / "GT" / "LABELS_Correct" / name
    return ImageFiles(
        f"{_title(folder)}/{frame}", pano / "RGB" / name, labels, pano / "Depth" / name
    )


def _title(folder: Path) -> str:
    return f"sequence_{folder.name.split('-')[2]}"


def list_frames(folder: Path, images: str = "RGB/Stereo_Left/Omni_[FRBL]") -> list[str]:
    """List frames with a color image of a view, e.g. ``000000``, in order.

    Args:
        folder: Folder of the sequence.
        images: Folders of the images in it; ``pano/RGB`` for panoramas.
    """
    return sorted({path.stem for path in folder.glob(f"{images}/{_NAME}")})


def choose_frames(frames: Sequence[str], count: int = FRAMES) -> list[str]:
    """Return the frames that become panoramas: all, or every n-th from the first, about `count`.

    The choice of OmniSYNTHIA's authors (Zhang et al. 2019): n is the number of frames divided by
    `count`, rounded half up.

    >>> len(choose_frames([str(i) for i in range(1250)]))
    417
    """
    step = math.floor(len(frames) / count + 0.5) if len(frames) > count else 1
    return list(frames[::step])


def read_view_camera(folder: Path, size: tuple[int, int]) -> NDArray[np.float64]:
    """Read the camera matrix of all views of a sequence.

    It comes from ``CameraParams/intrinsics.txt``: focal length, x and y of the center, optionally
    the baseline. Without the file, it is the camera of the release.

    Args:
        folder: Folder of the sequence.
        size: Rows and columns of the views.

    Returns:
        ``(3, 3)`` K for integer pixel centers; the file counts from pixel corners.
    """
    path = _camera_file(folder)
    is_known = size == _SIZE and not path.exists()
    text = _CAMERA if is_known else path.read_text(encoding="utf-8")
    focal, x, y = [float(number) for number in text.replace(",", " ").split()][:3]
    return np.array([[focal, 0, x - 0.5], [0, focal, y - 0.5], [0, 0, 1]])


def _camera_file(folder: Path) -> Path:
    return folder / "CameraParams" / "intrinsics.txt"


def read_first_channel(path: Any) -> NDArray[Any]:
    """Decode the red or only channel of an image unchanged, ``(H, W)``.

    Raises:
        DataError: The file is broken.
    """
    image = read_pixels(path, indices=True)
    return image if image.ndim == 2 else image[..., 0]
