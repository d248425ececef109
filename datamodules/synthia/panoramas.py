"""OmniSYNTHIA from SYNTHIA: four views of a frame become one panorama.

The front view is in the middle of the panorama, every pixel belongs to one view, and depth is the
distance from the centre. The script that made the published panoramas (Zhang et al. 2019) has the
left view in the middle, a quarter turn away, keeps the z-depth of the views, and averages where
views overlap, labels included.
"""

from __future__ import annotations

import json
import os
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import cv2
import numpy as np

from datamodules.core.problems import Noted, raised
from datamodules.core.progress import show_progress
from datamodules.images.png import read_color_png
from datamodules.synthia.files import (
    GET_IT,
    PANORAMA_FORMATS,
    VIEW_FORMATS,
    VIEWS,
    check_files,
    list_frames,
    panorama_files,
    read_camera,
    sequence_folder,
    view_files,
)
from datamodules.synthia.pixels import INVALID, read_first_channel, read_view_labels
from datamodules.synthia.splits import FRAMES, choose_frames
from tangent_train.errors import DataError, SettingError
from tangent_train.files import write_bytes, write_text
from tangent_train.geometry import (
    equirect_latitudes,
    equirect_to_lonlat,
    lonlat_to_xyz,
    perspective_directions,
    rotation_about,
)
from tangent_train.json_text import parse_json

if TYPE_CHECKING:
    from collections.abc import Generator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray


__all__ = ["HEIGHT", "MANIFEST", "ViewStitcher", "make_panoramas"]

HEIGHT = 2096
"""Rows of the published panoramas."""

MANIFEST = "tangent_train.json"
"""File in ``pano`` that says that the panoramas there were made here, and how."""

_NOWHERE = -2  # a position outside all images, whatever interpolation reads around it
_MOST = np.iinfo(np.uint16).max
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


class ViewStitcher:
    """Makes panoramas of the four views of a frame; the tables for it are computed once.

    Args:
        camera_matrix: ``(3, 3)`` K of all views, integer pixel centres, without skew.
        size: Rows and columns of all views.
        height: Rows of the panorama, which is twice as wide.
    """

    def __init__(
        self, camera_matrix: NDArray[np.float64], size: tuple[int, int], height: int
    ) -> None:
        rows, columns = size
        owner, x, y = _view_positions(camera_matrix, height)
        # A view is seen up to the outer edges of its pixels. Beyond the outermost centres these are
        # repeated: in the stack of all views, the next rows are another view's.
        seen = (np.abs(x - (columns - 1) / 2) <= columns / 2) & (
            np.abs(y - (rows - 1) / 2) <= rows / 2
        )
        x, y = np.clip(x, 0, columns - 1), np.clip(y, 0, rows - 1) + owner * rows
        map_x, map_y = (np.where(seen, place, _NOWHERE).astype(np.float32) for place in (x, y))
        self._tables = {
            # To 1/32 pixel, as always with 8-bit images: faster, and half the memory.
            "bilinear": cv2.convertMaps(map_x, map_y, cv2.CV_16SC2),
            "nearest": cv2.convertMaps(map_x, map_y, cv2.CV_16SC2, nninterpolation=True),
        }
        self._distance_per_depth = 1 / perspective_directions(camera_matrix, size)[..., 2]

    def rgb(self, views: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Panorama ``(H, W, 3)`` of colour images in the order of `VIEWS`, bilinear; else black."""
        return self._stitch(views, "bilinear", 0)

    def labels(self, views: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Panorama ``(H, W)`` of labels, nearest; `INVALID` where no view looks."""
        return self._stitch(views, "nearest", INVALID)

    def depth(self, views: Sequence[NDArray[np.uint16]]) -> NDArray[np.uint16]:
        """Panorama ``(H, W)`` of distances from the centre, nearest; 0 where there is none.

        Args:
            views: Depth along the optical axes.

        Returns:
            In the same unit, rounded, at most 65535.
        """
        far = [np.minimum(view * self._distance_per_depth + 0.5, _MOST) for view in views]
        return self._stitch([view.astype(np.uint16) for view in far], "nearest", 0)

    def _stitch(
        self,
        views: Sequence[NDArray[Any]],
        interpolation: Literal["bilinear", "nearest"],
        elsewhere: int,
    ) -> NDArray[Any]:
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
    """Which view owns each column of a panorama, and where its pixels are in that view.

    All pixels of a column belong to the view whose optical axis is nearest, as the views are
    upright: there they lie nearest to the middle of the image.

    Returns:
        ``(W,)`` place in `VIEWS`, ``(W,)`` columns and ``(H, W)`` rows.
    """
    width = 2 * height
    pixels = np.stack([np.arange(width), np.zeros(width)], axis=-1)
    lon = equirect_to_lonlat(pixels, (height, width))[:, 0]
    level = lonlat_to_xyz(np.stack([lon, np.zeros(width)], axis=-1))
    turns = [rotation_about((0, 0, 1), k * np.pi / 2) for k in range(len(VIEWS))]
    ahead, right, _ = np.moveaxis(np.stack([level @ turn for turn in turns]), -1, 0)
    owner = ahead.argmax(axis=0)
    columns = np.arange(width)
    ahead, right = ahead[owner, columns], right[owner, columns]
    down = -np.tan(equirect_latitudes(height))[:, None] / ahead
    x = camera_matrix[0, 0] * right / ahead + camera_matrix[0, 2]
    return owner, x, camera_matrix[1, 1] * down + camera_matrix[1, 2]


class _Job(NamedTuple):
    """A panorama to be made."""

    folder: Path
    frame: str
    stitcher: ViewStitcher


def make_panoramas(
    root: Path,
    sequences: Sequence[str],
    *,
    frames: int = FRAMES,
    height: int = HEIGHT,
    workers: int | None = None,
    progress: bool = True,
    noted: Noted = raised,
) -> int:
    """Write the panoramas of OmniSYNTHIA, as published, from the views of SYNTHIA.

    Whole files are kept, so that the work can be interrupted. Panoramas that were not made here are
    left alone, and none are added to them: they look another way.

    Args:
        root: Folder of the sequences.
        sequences: Which, as ``01``.
        frames: About how many of each sequence, see `choose_frames`.
        height: Rows of the panoramas.
        workers: Threads; by default one per CPU core.
        progress: Whether to show a progress bar.
        noted: Where broken views go, to go on with the other panoramas.

    Returns:
        How many were made.

    Raises:
        DataError: A file is missing or broken; a sequence has neither views nor panoramas, or
            panoramas that were made with other settings.
        SettingError: A number that cannot be.
    """
    if height < 1:
        raise SettingError("data.panorama_height", found=height, expected="1 or more")
    if workers is not None and workers < 0:
        raise SettingError("workers", found=workers, expected="0 or more, or None")
    jobs: list[_Job] = []
    total = 0
    for sequence in sequences:
        folder = sequence_folder(root, sequence)
        if _claim(folder, frames, height):
            chosen = choose_frames(list_frames(folder), frames)
            jobs += _unfinished(folder, chosen, height, noted)
            total += len(chosen)
    if jobs:
        # Threads: OpenCV leaves the GIL alone, and the tables are shared. As fast as processes.
        with closing(_in_threads(jobs, workers, noted)) as done:
            show_progress(
                done,
                "Making panoramas",
                "panoramas",
                total,
                before=total - len(jobs),
                show=progress,
            )
    return len(jobs)


def _claim(folder: Path, frames: int, height: int) -> bool:
    """Whether there are panoramas for us to make; if so, the folder for them is marked."""
    manifest = folder / "pano" / MANIFEST
    ready = manifest.exists() or any((folder / "pano").glob("**/[!.]*.png"))
    if not list_frames(folder):
        if ready:
            return False
        raise DataError(
            folder, found="neither views nor panoramas", expected="RGB, GT, Depth", remedy=GET_IT
        )
    wanted = {"front view at longitude": 0, "frames": frames, "height": height}
    if not manifest.exists():
        if not ready:
            write_text(manifest, json.dumps(wanted, indent=1) + "\n")
        return not ready
    try:
        found = parse_json(manifest.read_text(encoding="utf-8"))
    except ValueError:
        found = "something else"
    if found != wanted:
        raise DataError(
            manifest,
            found=found,
            expected=wanted,
            remedy="Use the settings of before, or remove the folder to make all anew.",
        )
    return True


def _unfinished(folder: Path, frames: Sequence[str], height: int, noted: Noted) -> list[_Job]:
    """What is to be made, after a check of all that it will be made from."""
    missing = [frame for frame in frames if not _is_whole(folder, frame, height)]
    size: tuple[int, int] | None = None
    whole = []
    for frame in missing:
        with noted((folder, frame)):
            for view in VIEWS:
                files = view_files(folder, view, frame, with_depth=True)
                found = check_files(files, VIEW_FORMATS)
                size = size or found
                if found != size:
                    raise DataError(
                        files.rgb,
                        found=f"{found[0]}×{found[1]} pixels",
                        expected=f"{size[0]}×{size[1]}, as in the other views of the sequence",
                        remedy="Extract the sequence again.",
                    )
            whole.append(frame)
    if size is None or not whole:
        return []
    stitcher = ViewStitcher(read_camera(folder, size), size, height)
    return [_Job(folder, frame, stitcher) for frame in whole]


def _is_whole(folder: Path, frame: str, height: int) -> bool:
    files = panorama_files(folder, frame, with_depth=True)
    try:
        return check_files(files, PANORAMA_FORMATS) == (height, 2 * height)
    except DataError:
        return False


def _in_threads(jobs: Sequence[_Job], workers: int | None, noted: Noted) -> Generator[None]:
    """Make panoramas; after an interrupt those begun are finished."""
    with ThreadPoolExecutor(max(1, os.cpu_count() or 1 if workers is None else workers)) as pool:
        try:
            futures = {pool.submit(_make, job): (job.folder, job.frame) for job in jobs}
            for future in as_completed(futures):
                try:
                    future.result()
                except DataError as error:  # of one frame; a disk that is full stops all
                    with noted(futures[future]):
                        raise error from None
                yield
        finally:
            pool.shutdown(cancel_futures=True)


def _make(job: _Job) -> None:
    views = [view_files(job.folder, view, job.frame, with_depth=True).parts for view in VIEWS]
    stitcher = job.stitcher
    rgb = stitcher.rgb([read_color_png(view["rgb"]) for view in views])
    parts = {
        "depth": stitcher.depth([read_first_channel(view["depth"]) for view in views]),
        "labels": stitcher.labels([read_view_labels(view["labels"]) for view in views]),
        # The last one: panoramas are those that have this file.
        "rgb": cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR),
    }
    paths = panorama_files(job.folder, job.frame, with_depth=True).parts
    for part, image in parts.items():
        write_bytes(paths[part], cv2.imencode(".png", image, _PNG)[1].tobytes())
