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
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from datamodules.core.depth import distance_from_z_depth
from datamodules.core.files import Problems
from datamodules.synthia import reader
from tangent_train.geometry import CubeGrid, PinholeGrid, equirect_directions
from tangent_train.io.pixel_files import read_image_size, read_rgb, write_pixels
from tangent_train.manifest import MANIFEST, Manifest
from tangent_train.progress import show_progress
from tangent_train.threads import in_threads

HEIGHT = 2096
"""Rows of the published panoramas."""

_NOWHERE = -2  # a position outside all images, whatever interpolation reads around it


class ViewStitcher:
    """Stitches the four views of a frame to a panorama; positions are computed once.

    Args:
        camera_matrix: ``(3, 3)`` K of all views, integer pixel centers; their middle is its center.
        size: Rows and columns of all views.
        height: Rows of the panorama, which is twice as wide.

    Attributes:
        camera_matrix: ``(3, 3)`` K of all views.
    """

    def __init__(
        self, camera_matrix: NDArray[np.float64], size: tuple[int, int], height: int
    ) -> None:
        self.camera_matrix = camera_matrix
        (rows, columns), axes = size, CubeGrid(2).world_from_camera[: len(reader.VIEWS)]
        grid = PinholeGrid(axes, size, 1 / camera_matrix[0, 0])
        directions = equirect_directions((height, 2 * height))
        owner = grid.owners(directions[height // 2])  # all pixels of a column have the same
        x, y = np.moveaxis(grid.project(directions, owner), -1, 0)
        # A view extends to the outer edges of its pixels. Beyond the outermost centers, these are
        # repeated: in the stack of all views, the next rows belong to another view.
        seen = (x >= -0.5) & (x <= columns - 0.5) & (y >= -0.5) & (y <= rows - 0.5)
        x, y = x.clip(0, columns - 1), y.clip(0, rows - 1) + owner * rows
        self._x, self._y = (np.where(seen, place, _NOWHERE).astype(np.float32) for place in (x, y))

    def stitch(
        self, views: Sequence[NDArray[Any]], interpolation: int, elsewhere: int = 0
    ) -> NDArray[Any]:
        """Return panorama ``(H, W[, C])`` of images in the order of `VIEWS`.

        Args:
            views: Images of the views.
            interpolation: ``cv2.INTER_LINEAR`` for colors, ``cv2.INTER_NEAREST`` for labels and
                distances.
            elsewhere: Value outside the views.
        """
        return cv2.remap(
            np.concatenate(views),
            self._x,
            self._y,
            interpolation,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=elsewhere,
        )


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
            target.depth: stitcher.stitch(far, cv2.INTER_NEAREST),
            target.labels: stitcher.stitch(ids, cv2.INTER_NEAREST, reader.INVALID),
            target.rgb: stitcher.stitch([read_rgb(view.rgb) for view in views], cv2.INTER_LINEAR),
        }
        for path, image in parts.items():
            write_pixels(path, image)
        manifest.finish(frame)
