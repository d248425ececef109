"""Folders of tangent images, rendered from panoramas."""

from __future__ import annotations

import os
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from datamodules.images.gpano import area_of, whole_area
from datamodules.images.image_files import IMAGE_SUFFIXES
from datamodules.images.pixel_files import read_pixels, write_pixels
from tangent_train.errors import DataError
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
    from collections.abc import Iterator

    from numpy.typing import NDArray

__all__ = ["TangentFolder", "read_panorama", "shrink_to_level"]

_COLMAP = "sparse"
_COLMAP_FILES = ("cameras.txt", "images.txt", "points3D.txt")
_RESIZABLE = (np.uint8, np.uint16, np.float32, np.float64)


def read_panorama(path: Path, interpolation: Interpolation) -> NDArray[Any]:
    """Read a panorama of any kind of number; parts of panoramas are laid onto the whole.

    Args:
        path: An image or a ``.npy`` file.
        interpolation: With ``nearest``, images with a palette give its indices.

    Returns:
        ``(H, W)`` or ``(H, W, C)``, the whole sphere; 0 where a part of a panorama shows nothing.

    Raises:
        DataError: The file cannot be used.
    """
    image = read_pixels(path, indices=interpolation == "nearest")
    height, width = image.shape[:2]
    area = area_of(path, (height, width)) if path.suffix.lower() in IMAGE_SUFFIXES else None
    if area is None and abs(width - 2 * height) > 1:
        raise DataError(
            path,
            found=f"{height}×{width} pixels",
            expected="a panorama, twice as wide as high",
            remedy="Of a part of a panorama, GPano tags in its XMP data have to say which.",
        )
    return (area or whole_area(path, (height, width))).place(image)


def shrink_to_level(image: NDArray[Any], level: int) -> NDArray[Any]:
    """Average areas of a panorama that has more rows than a level, as for training: no aliasing.

    Args:
        image: ``(H, W)`` or ``(H, W, C)`` numbers.
        level: Level s.

    Returns:
        The image itself, or one of the level's size; same dtype.
    """
    height, width = equirect_shape(level)
    if image.shape[0] <= height:
        return image
    # OpenCV knows few types, and few channels at once.
    source = image if image.dtype in _RESIZABLE else image.astype(np.float64)
    source = source if source.ndim == 3 else source[..., None]
    small = np.empty((height, width, source.shape[2]), source.dtype)
    for first in range(0, source.shape[2], 4):
        group = np.ascontiguousarray(source[..., first : first + 4])
        part = cv2.resize(group, (width, height), interpolation=cv2.INTER_AREA)
        small[..., first : first + 4] = part.reshape(height, width, -1)
    if image.dtype not in _RESIZABLE:
        small = (np.rint(small) if image.dtype.kind in "ui" else small).astype(image.dtype)
    return small if image.ndim == 3 else small[..., 0]


@dataclass(frozen=True)
class TangentFolder:
    """A folder with the tangent images of one panorama and their cameras.

    Attributes:
        path: The folder.
        cameras: What its ``cameras.json`` will say.
        colmap: Whether it has a folder of COLMAP's text files as well.
    """

    path: Path
    cameras: CameraFile
    colmap: bool

    def write(self, image: NDArray[Any], interpolation: Interpolation) -> Iterator[str]:
        """Render and write all images; nothing is to be seen of them before all are there.

        Args:
            image: ``(H, W)`` or ``(H, W, C)`` panorama.
            interpolation: As of `equirect_to_tangent`.

        Yields:
            The name of every file when it is written.

        Raises:
            SettingError: The panorama cannot be rendered, or the files cannot hold its pixels.
        """
        grid, faces = (
            self.cameras.grid,
            dict(zip(self.cameras.files, self.cameras.faces, strict=True)),
        )
        with self._unfinished() as folder:

            def render(file: str) -> str:
                (pixels,) = equirect_to_tangent(image, grid, [faces[file]], interpolation)
                write_pixels(folder / file, pixels)
                return file

            pool = ThreadPoolExecutor(os.cpu_count() or 1)
            try:
                yield from pool.map(render, self.cameras.files)
            finally:
                pool.shutdown(cancel_futures=True)
            if self.colmap:
                write_colmap(folder / _COLMAP, self.cameras)
            write_cameras(folder / CAMERAS_FILE, self.cameras)

    @contextmanager
    def _unfinished(self) -> Iterator[Path]:
        """A folder that becomes this one when the block succeeds."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(dir=self.path.parent, prefix=".partial-"))
        folder.chmod(0o755)
        try:
            yield folder
            if self.path.exists():
                self._remove_earlier()
                self._move_into_place(folder)
            else:
                folder.rename(self.path)
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def _remove_earlier(self) -> None:
        """Remove what an earlier run left, and only that: other sizes have other names."""
        marker = self.path / CAMERAS_FILE
        try:
            files = read_cameras(marker).files
        except DataError:
            files = ()
        marker.unlink(missing_ok=True)
        # Names from a file: only those that lie in this folder.
        for file in (name for name in files if Path(name).name == name):
            (self.path / file).unlink(missing_ok=True)
        for file in _COLMAP_FILES:
            (self.path / _COLMAP / file).unlink(missing_ok=True)
        if (self.path / _COLMAP).is_dir() and not any((self.path / _COLMAP).iterdir()):
            (self.path / _COLMAP).rmdir()

    def _move_into_place(self, folder: Path) -> None:
        """The cameras last: they say that a folder is whole."""
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        for file in sorted(files, key=lambda file: file.name == CAMERAS_FILE):
            target = self.path / file.relative_to(folder)
            target.parent.mkdir(exist_ok=True)
            file.replace(target)
