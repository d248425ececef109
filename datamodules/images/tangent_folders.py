"""Folders of tangent images, rendered from panoramas."""

from __future__ import annotations

import os
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from datamodules.images.gpano import area_of, whole_area
from datamodules.images.image_files import IMAGE_SUFFIXES
from datamodules.images.pixel_files import read_pixels, write_pixels
from tangent_train.errors import SettingError
from tangent_train.geometry import equirect_shape
from tangent_train.rendering import Interpolation, equirect_to_tangent
from tangent_train.rendering.camera_files import (
    CAMERAS_FILE,
    CameraFile,
    read_cameras,
    write_cameras,
    write_colmap,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

__all__ = ["read_panorama", "shrink_to_level", "write_tangent_folder"]

_COLMAP = "sparse"
_RESIZABLE = (np.uint8, np.uint16, np.float32, np.float64)


def read_panorama(path: Path, interpolation: Interpolation) -> NDArray[Any]:
    """Read a panorama of any dtype; a part of a panorama is placed on the whole sphere.

    Args:
        path: An image or a ``.npy`` file.
        interpolation: With ``nearest``, images with a palette give its indices.

    Returns:
        ``(H, W)`` or ``(H, W, C)``, the whole sphere; 0 where a part of a panorama shows nothing.

    Raises:
        DataError: The file cannot be used.
    """
    image = read_pixels(path, indices=interpolation == "nearest")
    size = (image.shape[0], image.shape[1])
    tagged = path.suffix.lower() in IMAGE_SUFFIXES
    return (area_of(path, size) if tagged else whole_area(path, size)).place(image)


def shrink_to_level(image: NDArray[Any], level: int) -> NDArray[Any]:
    """Downsample a panorama with more rows than a level by area averaging.

    Args:
        image: ``(H, W)`` or ``(H, W, C)``; other dtypes than uint8, uint16, float32 and float64
            are not averaged.
        level: Level s.

    Returns:
        The image itself, or one of the level's size.
    """
    height, width = equirect_shape(level)
    if image.shape[0] <= height or image.dtype not in _RESIZABLE:
        return image
    channels = np.atleast_3d(image)
    small = np.empty((height, width, channels.shape[2]), image.dtype)
    for k in range(channels.shape[2]):  # OpenCV takes four channels at most
        one = np.ascontiguousarray(channels[..., k])
        small[..., k] = cv2.resize(one, (width, height), interpolation=cv2.INTER_AREA)
    return small.reshape(height, width, *image.shape[2:])


def write_tangent_folder(
    folder: Path,
    image: NDArray[Any],
    cameras: CameraFile,
    interpolation: Interpolation,
    progress: Callable[[float], object],
    *,
    colmap: bool,
) -> None:
    """Render tangent images to a folder, which appears once complete.

    Args:
        folder: A new one, or one with tangent images of an earlier run, which it replaces.
        image: ``(H, W)`` or ``(H, W, C)`` panorama.
        cameras: Content of its ``cameras.json``.
        interpolation: As of `equirect_to_tangent`.
        progress: Called with the share of the images written since its last call.
        colmap: Whether to write COLMAP's text files too.

    Raises:
        SettingError: The panorama cannot be rendered, the files cannot hold its pixels, or the
            folder holds other files.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(dir=folder.parent, prefix=".partial-"))

    def render(face: int, file: str) -> None:
        (pixels,) = equirect_to_tangent(image, cameras.grid, [face], interpolation)
        write_pixels(unfinished / file, pixels)

    pool = ThreadPoolExecutor(os.cpu_count() or 1)
    try:
        unfinished.chmod(0o755)
        for _ in pool.map(render, cameras.faces, cameras.files):
            progress(1 / len(cameras.files))
        if colmap:
            write_colmap(unfinished / _COLMAP, cameras)
        write_cameras(unfinished / CAMERAS_FILE, cameras)
        _remove_earlier(folder)
        unfinished.rename(folder)
    finally:
        pool.shutdown(cancel_futures=True)
        shutil.rmtree(unfinished, ignore_errors=True)


def _remove_earlier(folder: Path) -> None:
    """Remove a folder that holds only the files of an earlier run."""
    there = {path.relative_to(folder) for path in folder.rglob("*") if not path.is_dir()}
    if there:
        ours = {Path(CAMERAS_FILE), *map(Path, read_cameras(folder / CAMERAS_FILE).files)}
        ours |= {Path(_COLMAP, f"{name}.txt") for name in ("cameras", "images", "points3D")}
        if there - ours:
            raise SettingError(
                "output",
                found=f"{folder / min(there - ours)}, which is no tangent image of {folder}",
                expected="a folder that may be replaced",
                remedy="Move the file, or choose another output.",
            )
    if folder.exists():
        shutil.rmtree(folder)
