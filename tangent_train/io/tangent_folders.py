"""Folders of tangent images, rendered from panoramas."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.geometry import PinholeGrid, equirect_shape
from tangent_train.io import camera_files
from tangent_train.io.gpano import PanoramaArea, area_of_angles, read_area, whole_area
from tangent_train.io.pixel_files import read_pixels, write_pixels
from tangent_train.io.videos import VIDEO_SUFFIXES
from tangent_train.rendering import Interpolation, equirect_to_tangent
from tangent_train.threads import in_threads

_RESIZABLE = (np.uint8, np.uint16, np.float32, np.float64)


def panorama_area(
    path: Path, size: tuple[int, int], angles: Sequence[float] | None = None
) -> PanoramaArea:
    """Return the part of the sphere that a file shows.

    Args:
        path: Image, array or video; arrays and videos have no GPano tags.
        size: Rows and columns of the image or of a frame of the video.
        angles: Part of the sphere, see `area_of_angles`; None to read it from GPano tags.

    Raises:
        DataError: The file is neither a whole panorama nor tagged as a part.
        SettingError: The angles do not fit.
    """
    if angles is not None:
        return area_of_angles(size, angles)
    is_tagged = path.suffix.lower() not in (".npy", ".exr", *VIDEO_SUFFIXES)
    return read_area(path, size) if is_tagged else whole_area(path, size)


def read_placed(
    path: Path,
    interpolation: Interpolation,
    angles: Sequence[float] | None = None,
    frame: Callable[[], NDArray[np.uint8]] | None = None,
) -> tuple[NDArray[Any], PanoramaArea]:
    """Read a panorama of any dtype; place a part of a panorama on the whole sphere.

    Args:
        path: An image, an array or a video.
        interpolation: With ``nearest``, images with a palette give its indices.
        angles: See `panorama_area`.
        frame: Function that returns the frame of a video.

    Returns:
        ``(H, W)`` or ``(H, W, C)`` of the whole sphere, 0 outside of the part; and the part.

    Raises:
        DataError: The file cannot be used.
        SettingError: The angles do not fit.
    """
    image = read_pixels(path, indices=interpolation == "nearest") if frame is None else frame()
    area = panorama_area(path, (image.shape[0], image.shape[1]), angles)
    return area.place(image), area


def face_name(grid: PinholeGrid, face: int) -> str:
    """Return the name of a tangent image, e.g. ``face_007``; names sort like the images."""
    return f"face_{face:0{max(3, len(str(grid.num_images - 1)))}}"


def shrink_to_level(image: NDArray[Any], level: int) -> NDArray[Any]:
    """Downsample a panorama that has more rows than a level, by area averaging.

    Args:
        image: ``(H, W)`` or ``(H, W, C)``; other dtypes than uint8, uint16, float32 and float64
            are not averaged.
        level: Level s.

    Returns:
        The image itself, or a copy of the level's size.
    """
    height, width = equirect_shape(level)
    if image.shape[0] <= height or image.dtype not in _RESIZABLE:
        return image
    small = [  # OpenCV takes four channels at most
        cv2.resize(np.ascontiguousarray(channel), (width, height), interpolation=cv2.INTER_AREA)
        for channel in np.moveaxis(np.atleast_3d(image), -1, 0)
    ]
    return np.stack(small, axis=-1).reshape(height, width, *image.shape[2:])


def write_tangent_folder(
    folder: Path,
    image: NDArray[Any],
    cameras: camera_files.CameraFile,
    interpolation: Interpolation,
    progress: Callable[[float], object],
) -> None:
    """Render tangent images to a folder; files of the same names are replaced.

    Args:
        folder: Output folder.
        image: ``(H, W)`` or ``(H, W, C)`` panorama.
        cameras: Content of ``cameras.json``.
        interpolation: See `equirect_to_tangent`.
        progress: Called with the share of the images written since its last call.

    Raises:
        SettingError: The panorama cannot be rendered, or the files cannot hold its pixels.
    """

    def render(file: str, face: int) -> None:
        (pixels,) = equirect_to_tangent(image, cameras.grid, [face], interpolation)
        write_pixels(folder / file, pixels)

    write_each(render, dict(zip(cameras.files, cameras.faces, strict=True)), progress)
    camera_files.write_cameras(folder / camera_files.CAMERAS_FILE, cameras)


def write_each(
    write: Callable[[str, int], None], faces: Mapping[str, int], progress: Callable[[float], object]
) -> None:
    """Write the images of some faces in threads.

    Args:
        write: Function of the name of an image and its face.
        faces: Faces by name.
        progress: Called with the share of the images written since its last call.
    """
    with closing(in_threads(lambda face: write(*face), faces.items())) as written:
        for _ in written:
            progress(1 / len(faces))
