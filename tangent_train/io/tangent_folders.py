"""Folders of tangent images, rendered from panoramas."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tangent_train.errors import SettingError
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
    """Render tangent images to a folder, which appears when it is complete.

    Args:
        folder: New folder, or a folder of an earlier run, which is replaced.
        image: ``(H, W)`` or ``(H, W, C)`` panorama.
        cameras: Content of ``cameras.json``.
        interpolation: See `equirect_to_tangent`.
        progress: Called with the share of the images written since its last call.

    Raises:
        SettingError: The panorama cannot be rendered, the files cannot hold its pixels, or the
            folder holds other files.
    """

    def render(file: str, face: int) -> None:
        (pixels,) = equirect_to_tangent(image, cameras.grid, [face], interpolation)
        write_pixels(unfinished / file, pixels)

    with replaced_folder(folder) as unfinished:
        write_each(render, dict(zip(cameras.files, cameras.faces, strict=True)), progress)
        camera_files.write_cameras(unfinished / camera_files.CAMERAS_FILE, cameras)


@contextmanager
def replaced_folder(folder: Path) -> Iterator[Path]:
    """Return a context that fills a folder; the folder appears when the context succeeds.

    Args:
        folder: New folder, or a folder that holds only files of an earlier run.

    Raises:
        SettingError: The folder holds other files.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(dir=folder.parent, prefix=".partial-"))
    try:
        unfinished.chmod(0o755)
        yield unfinished
        _remove_earlier(folder)
        unfinished.rename(folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


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


def _remove_earlier(folder: Path) -> None:
    """Remove a folder that holds only the files of an earlier run."""
    there = {path.relative_to(folder) for path in folder.rglob("*") if not path.is_dir()}
    if there:
        written = _written(folder)
        if there - written:
            raise SettingError(
                "output",
                found=f"{folder / min(there - written)}, which is not a tangent image of {folder}",
                expected="a folder that may be replaced",
                remedy="Move the file, or choose another output.",
            )
    if folder.exists():
        shutil.rmtree(folder)


def _written(folder: Path) -> set[Path]:
    if (folder / camera_files.RIG_FILE).is_file():
        images = camera_files.read_rig(folder / camera_files.RIG_FILE).images
        masks = (Path("masks", f"{image}.png") for image in images)
        return {Path(camera_files.RIG_FILE), *(Path("images", image) for image in images), *masks}
    return {
        Path(camera_files.CAMERAS_FILE),
        *map(Path, camera_files.read_cameras(folder / camera_files.CAMERAS_FILE).files),
    }
