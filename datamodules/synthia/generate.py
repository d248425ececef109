"""Generating OmniSYNTHIA from SYNTHIA: the four views of a frame form one panorama.

The front view is in the middle of the panorama, every pixel belongs to one view, and depth is the
distance from the center. The script of the published panoramas (Zhang et al. 2019) puts the left
view in the middle (90° away), keeps the z-depth of the views, and averages overlapping views,
including labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from datamodules.core.depth import distance_from_z_depth
from datamodules.core.files import Problems
from datamodules.synthia import reader
from tangent_train.geometry import (
    equirect_latitudes,
    equirect_longitudes,
    lonlat_to_xyz,
    rotation_about,
)
from tangent_train.io.pixel_files import read_image_size, read_rgb, write_pixels
from tangent_train.manifest import MANIFEST, Manifest
from tangent_train.progress import show_progress
from tangent_train.threads import in_threads

HEIGHT = 2096
"""Rows of the published panoramas."""

_NOWHERE = -2  # a position outside all images, whatever interpolation reads around it


class ViewStitcher:
    """Stitches the four views of a frame to a panorama; its tables are computed once.

    Args:
        camera_matrix: ``(3, 3)`` K of all views, integer pixel centers, without skew.
        size: Rows and columns of all views.
        height: Rows of the panorama, which is twice as wide.

    Attributes:
        camera_matrix: ``(3, 3)`` K of all views.
    """

    def __init__(
        self, camera_matrix: NDArray[np.float64], size: tuple[int, int], height: int
    ) -> None:
        rows, columns = size
        owner, x, y = _view_positions(camera_matrix, height)
        # A view extends to the outer edges of its pixels. Beyond the outermost centers, these are
        # repeated: in the stack of all views, the next rows belong to another view.
        seen = (np.abs(x - (columns - 1) / 2) <= columns / 2) & (
            np.abs(y - (rows - 1) / 2) <= rows / 2
        )
        x, y = np.clip(x, 0, columns - 1), np.clip(y, 0, rows - 1) + owner * rows
        map_x, map_y = (np.where(seen, place, _NOWHERE).astype(np.float32) for place in (x, y))
        self._tables = {
            # OpenCV's precision for 8-bit images, 1/32 pixel: faster, and half the memory.
            "bilinear": cv2.convertMaps(map_x, map_y, cv2.CV_16SC2),
            "nearest": cv2.convertMaps(map_x, map_y, cv2.CV_16SC2, nninterpolation=True),
        }
        self.camera_matrix = camera_matrix

    def stitch(
        self,
        views: Sequence[NDArray[Any]],
        interpolation: Literal["bilinear", "nearest"],
        elsewhere: int = 0,
    ) -> NDArray[Any]:
        """Return panorama ``(H, W[, C])`` of images in the order of `VIEWS`.

        Args:
            views: Images of the views.
            interpolation: `bilinear` for colors, `nearest` for labels and distances.
            elsewhere: Value outside the views.
        """
        return cv2.remap(
            np.concatenate(views),
            *self._tables[interpolation],
            cv2.INTER_NEAREST if interpolation == "nearest" else cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=elsewhere,
        )


def _view_positions(
    camera_matrix: NDArray[np.float64], height: int
) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64]]:
    """Return the view that owns each column of a panorama, and its pixels in that view.

    All pixels of a column belong to the view whose optical axis is nearest, as the views are
    upright: there they are nearest to the image center.

    Returns:
        ``(W,)`` index in `VIEWS`, ``(W,)`` columns and ``(H, W)`` rows.
    """
    width = 2 * height
    level = lonlat_to_xyz(np.stack([equirect_longitudes(width), np.zeros(width)], axis=-1))
    rotations = [rotation_about((0, 0, 1), k * np.pi / 2) for k in range(len(reader.VIEWS))]
    ahead, right, _ = np.moveaxis(np.stack([level @ rotation for rotation in rotations]), -1, 0)
    owner = ahead.argmax(axis=0)
    columns = np.arange(width)
    ahead, right = ahead[owner, columns], right[owner, columns]
    down = -np.tan(equirect_latitudes(height))[:, None] / ahead
    x = camera_matrix[0, 0] * right / ahead + camera_matrix[0, 2]
    return owner, x, camera_matrix[1, 1] * down + camera_matrix[1, 2]


def make_panoramas(
    root: Path,
    sequences: Sequence[str],
    problems: Problems,
    *,
    frames: int = reader.FRAMES,
    height: int = HEIGHT,
) -> None:
    """Write the panoramas of OmniSYNTHIA, as published, from the views of SYNTHIA.

    Finished panoramas are kept, so that the work can be interrupted. Published panoramas stay
    unchanged and are not mixed with generated ones, whose heading differs.

    Args:
        root: Folder of the sequences.
        sequences: Sequences, e.g. ``01``.
        problems: Collects broken views by name of the panorama.
        frames: Approximate number of frames per sequence, see `choose_frames`.
        height: Rows of the panoramas.

    Raises:
        DataError: A sequence has neither views nor panoramas.
        SettingError: A sequence has panoramas that were generated with other settings.
    """
    for sequence in sequences:
        folder = reader.sequence_folder(root, sequence)
        is_generated = (folder / "pano" / MANIFEST).exists()
        views = reader.list_frames(folder)
        if not views or (any(folder.glob("pano/RGB/*.png")) and not is_generated):
            continue
        settings = {"generator": "OmniSYNTHIA", "frames": frames, "height": height}
        manifest = Manifest.open(folder / "pano", settings, is_shared=True)
        chosen = reader.choose_frames(views, frames)
        missing = manifest.missing(chosen)
        size = read_image_size(reader.view_files(folder, chosen[0], reader.VIEWS[0]).rgb)
        stitcher = ViewStitcher(reader.read_view_camera(folder, size), size, height)
        make = partial(_make, stitcher, folder, problems, manifest)
        # Threads, as fast as processes: OpenCV releases the GIL, and the tables are shared.
        # Closed, so that an interrupt drops queued work.
        with closing(in_threads(make, missing)) as made:
            before = len(chosen) - len(missing)
            show_progress(made, f"Making panoramas of {sequence}", "panoramas", len(chosen), before)


def _make(
    stitcher: ViewStitcher, folder: Path, problems: Problems, manifest: Manifest, frame: str
) -> None:
    """Write the panorama of a frame, unless a view is broken."""
    target = reader.panorama_files(folder, frame)
    views = [reader.view_files(folder, frame, view) for view in reader.VIEWS]
    with problems.noted(target.name):
        depth = [reader.read_first_channel(view.depth) for view in views]
        far = [distance_from_z_depth(one, stitcher.camera_matrix) for one in depth]
        ids = [reader.read_first_channel(view.labels).astype(np.uint8) for view in views]
        parts: dict[Any, NDArray[Any]] = {
            target.depth: stitcher.stitch(far, "nearest"),
            target.labels: stitcher.stitch(ids, "nearest", reader.INVALID),
            target.rgb: stitcher.stitch([read_rgb(view.rgb) for view in views], "bilinear"),
        }
        for path, image in parts.items():
            write_pixels(path, image)
        manifest.finish(frame)
