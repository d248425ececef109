"""The user's own images as network input."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from datamodules.core.panoramas import meters_to_steps, resize_nearest
from datamodules.images.gpano import PanoramaArea, up_of
from datamodules.images.image_files import NamedFiles, find_depth
from datamodules.images.pixel_files import photo_fov_deg, read_depth_m, read_rgb
from datamodules.images.tangent_folders import panorama_area
from tangent_train.errors import DataError, width_height
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.inference.views import InputImage
from tangent_train.rendering.upright.gravity import estimate_up

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from datamodules.core.image_module import Upright
    from tangent_train.inference.judge import NetworkJudge

_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class DepthFolder:
    """Depth images named as the images they belong to, or with ``_depth`` at the end.

    Attributes:
        path: The folder.
        units_per_m: Of files with whole numbers.
    """

    path: Path
    units_per_m: float

    @cached_property
    def _files(self) -> NamedFiles:
        return NamedFiles(self.path)

    def read(self, name: str, shape: tuple[int, int]) -> NDArray[np.uint16]:
        """Depth of an image in steps of 1/512 m, 0 where missing.

        Args:
            name: Of the image, see `find_depth`.
            shape: Its rows and columns.

        Raises:
            DataError: There is none, it is broken, or its aspect ratio is another.
        """
        remedy = "Put depth into a folder of its own, with the names of the images."
        path = find_depth(self._files, name, remedy)
        depth_m = read_depth_m(path, self.units_per_m)
        height, width = depth_m.shape
        if abs(width * shape[0] / (height * shape[1]) - 1) > _ASPECT_TOLERANCE:
            raise DataError(
                path,
                found=width_height((height, width)),
                expected=f"the aspect ratio of the image, {width_height(shape)}",
            )
        return meters_to_steps(resize_nearest(depth_m, shape))


def read_panorama(
    path: Path,
    name: str,
    depth: DepthFolder | None = None,
    crop: Sequence[float] | None = None,
    upright: Upright = None,
    frame: Callable[[], NDArray[np.uint8]] | None = None,
) -> tuple[InputImage, PanoramaArea]:
    """Read a panorama of the whole sphere or a part of it.

    Args:
        path: Its file.
        name: Its path below the folder of all images, without suffix.
        depth: Its depth file, for networks with depth.
        crop: Its part of the sphere, see `area_of_crop`; None for that of its GPano tags.
        upright: Source of its zenith: ``pose`` by its GPano tags, ``auto`` likewise, see
            `with_up`; None for z.
        frame: Gives the frame, if the file is a video; videos have no GPano tags.

    Returns:
        The whole sphere, black outside the file's area, and that area.

    Raises:
        DataError: A file cannot be used.
        SettingError: The crop does not fit the image.
    """
    rgb = read_rgb(path) if frame is None else frame()
    size = (rgb.shape[0], rgb.shape[1])
    area = panorama_area(path, size, crop)
    whole = area.place(rgb)
    placed_depth = None if depth is None else area.place(depth.read(name, size))
    up = None if upright is None or frame is not None else up_of(path)
    return InputImage(whole, placed_depth, up), area


def with_up(image: InputImage, max_tilt_deg: float, judge: NetworkJudge) -> InputImage:
    """A panorama with its zenith: its own, or else as estimated.

    Args:
        image: A panorama.
        max_tilt_deg: Of estimates, see `estimate_up`.
        judge: Helps to estimate.
    """
    if image.up is not None:
        return image
    return replace(image, up=estimate_up(image.rgb, max_tilt_deg, partial(judge, image)))


def read_photo(
    path: Path,
    name: str,
    depth: DepthFolder | None = None,
    fov_deg: float | None = None,
    frame: Callable[[], NDArray[np.uint8]] | None = None,
) -> InputImage:
    """Read a photo.

    Args:
        path: Its file.
        name: Its path below the folder of all images, without suffix.
        depth: File of its z-depth, for networks with depth.
        fov_deg: Its horizontal field of view; None for what its EXIF data say.
        frame: Gives the frame, if the file is a video; videos have no EXIF data.

    Raises:
        DataError: A file cannot be used, or the field of view is unknown.
    """
    rgb = read_rgb(path) if frame is None else frame()
    size = (rgb.shape[0], rgb.shape[1])
    if fov_deg is None and frame is None:
        fov_deg = photo_fov_deg(path)
    if fov_deg is None:
        raise DataError(
            path,
            found="no focal length in its EXIF data",
            expected="the field of view, which gives the angular resolution",
            remedy="Give fov=, the horizontal one in degrees: 65 to 80 for most phones.",
        )
    depth_steps = None if depth is None else depth.read(name, size)
    return InputImage(rgb, depth_steps, camera_matrix=camera_matrix_from_fov(fov_deg, size))
