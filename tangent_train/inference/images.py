"""Read users' images, from files and from memory, as network input."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from datamodules.core.depth import meters_to_steps, resize_depth
from datamodules.core.label_map import PIXEL_CLASSES
from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.io.gpano import PanoramaArea, eye_part, read_area, read_tags, read_up
from tangent_train.io.image_files import NamedFiles, find_depth
from tangent_train.io.pixel_files import photo_fov_deg, read_depth_m, read_rgb
from tangent_train.io.videos import Frame
from tangent_train.orientation.gravity import estimate_up
from tangent_train.rendering.resampling import is_tensor, resize

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from torch import Tensor

    from tangent_train.inference.engine import UpLikelihood
    from tangent_train.io.gpano import Eye
    from tangent_train.kinds import Upright

    DepthOfSize = Callable[[tuple[int, int]], NDArray[np.uint16]]
    """Returns depth of an image of a size, in steps of 1/512 m."""

Picture: TypeAlias = "str | Path | Image.Image | NDArray[Any] | Tensor"
"""A file; a Pillow image; or RGB from 0 to 255, an array ``(H, W, 3)`` or tensor ``(3, H, W)`` of
uint8 on any device."""

_ASPECT_TOLERANCE = 0.01
_IN_MEMORY = Path("image")


@dataclass(frozen=True)
class InputImage:
    """A panorama of the whole sphere, or a photo.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        depth: ``(H, W)`` uint16 in steps of 1/512 m, 0 where missing; or None. It is the distance
            from the center in panoramas, and z-depth in photos.
        up: ``(3,)`` direction of the zenith in a panorama; None if it is z.
        camera_matrix: ``(3, 3)`` K of a photo, integer pixel centers; None for panoramas.
        area: The part of the sphere that a panorama shows; it is black elsewhere. None for photos.
        rotation: ``(3, 3)`` rotation of the views of a panorama with `up`; None for the smallest
            one that turns z to `up`.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None = None
    up: NDArray[np.float64] | None = None
    camera_matrix: NDArray[np.float64] | None = None
    area: PanoramaArea | None = None
    rotation: NDArray[np.float64] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rgb.shape[0], self.rgb.shape[1]

    @property
    def is_panorama(self) -> bool:
        """True for a panorama, False for a photo."""
        return self.camera_matrix is None

    @property
    def valid(self) -> NDArray[np.bool_] | None:
        """``(H, W)`` valid pixels of a partial panorama; None if all are valid."""
        return None if self.area is None else self.area.valid

    def cut(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Cut pixels ``(H, W[, C])`` to the area of a partial panorama."""
        return pixels if self.area is None else self.area.cut(pixels)

    def resized(self, shape: tuple[int, int]) -> InputImage:
        """Return the image resized as in training; depth is not averaged."""
        depth = None if self.depth is None else resize_depth(self.depth, shape)
        return replace(self, rgb=resize(self.rgb, shape, "bilinear"), depth=depth)


@dataclass(frozen=True)
class DepthFolder:
    """A folder of depth images with the names of the RGB images, or with ``_depth`` at the end.

    Attributes:
        path: Path of the folder.
        units_per_m: Units per meter in files with integers.
        channel: Channel of depth in OpenEXR images, see `read_depth_m`.
    """

    path: Path
    units_per_m: float
    channel: str | None = None

    @cached_property
    def _files(self) -> NamedFiles:
        return NamedFiles(self.path)

    def read(self, name: str, shape: tuple[int, int]) -> NDArray[np.uint16]:
        """Read the depth of an image in steps of 1/512 m, 0 where missing.

        Args:
            name: Name of the image, see `find_depth`.
            shape: Rows and columns of the image.

        Raises:
            DataError: The depth image is missing, broken, or has another aspect ratio.
        """
        remedy = "Put depth into a folder of its own, with the names of the images."
        path = find_depth(self._files, name, remedy)
        depth_m = read_depth_m(path, self.units_per_m, self.channel)
        height, width = depth_m.shape
        if abs(width * shape[0] / (height * shape[1]) - 1) > _ASPECT_TOLERANCE:
            raise DataError(
                path,
                found=width_height((height, width)),
                expected=f"the aspect ratio of the image, {width_height(shape)}",
            )
        return meters_to_steps(resize(depth_m, shape, "nearest"))


def read_panorama(
    image: Picture | Frame,
    angles: Sequence[float] | None = None,
    upright: Upright = None,
    depth: DepthOfSize | None = None,
    eye: Eye | None = None,
) -> InputImage:
    """Read a panorama of the whole sphere or a part of it.

    Args:
        image: The panorama; only files and frames have GPano tags.
        angles: Part of the sphere that it covers, see `read_area`; None to use its GPano tags.
        upright: Source of the zenith: ``pose`` and ``auto`` read GPano tags (without tags,
            `with_up` estimates it for ``auto``); None for z.
        depth: Function that returns its depth.
        eye: Eye of a stereo panorama, see `eye_part`; frames have only one.

    Returns:
        An image of the whole sphere, black outside its area.

    Raises:
        DataError: A file cannot be used, or the image is not a whole panorama.
        SettingError: The angles do not fit the image, the value is not an image, or an image in
            memory or a frame has no pose.
    """
    rgb, path = _read(image)
    tags = image.tags if isinstance(image, Frame) else read_tags(path) if path else {}
    if upright == "pose" and path is None and "PosePitchDegrees" not in tags:
        expected = "the path of a file: images in memory and videos without metadata have no pose"
        raise SettingError("upright", found="pose", expected=expected)
    path = path or _IN_MEMORY
    if not isinstance(image, Frame):
        rgb = rgb[eye_part(path, (rgb.shape[0], rgb.shape[1]), eye, angles, tags)]
    size = rgb.shape[0], rgb.shape[1]
    area = read_area(path, size, angles, tags=tags)
    steps = None if depth is None else area.place(depth(size))
    up = None if upright is None else read_up(path, tags)
    return InputImage(area.place(rgb), steps, up, area=area)


def with_up(image: InputImage, max_tilt_deg: float, up_likelihood: UpLikelihood) -> InputImage:
    """Return a panorama with its zenith, which is estimated if it is not given.

    Args:
        image: A panorama.
        max_tilt_deg: Largest tilt of an estimate, see `estimate_up`.
        up_likelihood: Evidence for the estimate, from the confidence of a network.
    """
    if image.up is not None:
        return image
    up_likelihood.loaded.check_predicts(PIXEL_CLASSES, "Leave upright=auto out: use pose.")
    return replace(image, up=estimate_up(image.rgb, max_tilt_deg, partial(up_likelihood, image)))


def read_photo(
    image: Picture | Frame, fov_deg: float | None = None, depth: DepthOfSize | None = None
) -> InputImage:
    """Read a photo.

    Args:
        image: The photo; only files have EXIF data.
        fov_deg: Horizontal field of view in degrees; None to read it from EXIF data.
        depth: Function that returns its z-depth.

    Raises:
        DataError: A file cannot be used, or the field of view is unknown.
        SettingError: The value is not an image.
    """
    rgb, path = _read(image)
    size = rgb.shape[0], rgb.shape[1]
    if fov_deg is None and path is not None:
        fov_deg = photo_fov_deg(path)
    if fov_deg is None:
        raise DataError(
            path or _IN_MEMORY,
            found="no focal length in its EXIF data",
            expected="the field of view, which determines the angular resolution",
            remedy="Give fov=, the horizontal field of view in degrees: 65 to 80 for most phones.",
        )
    matrix = camera_matrix_from_fov(fov_deg, size)
    return InputImage(rgb, None if depth is None else depth(size), camera_matrix=matrix)


def _read(image: Any) -> tuple[NDArray[np.uint8], Path | None]:
    """Return an image as ``(H, W, 3)`` uint8, and the path of a file."""
    if isinstance(image, str | Path):
        return read_rgb(Path(image)), Path(image)
    if isinstance(image, Frame):
        return image(), None
    if isinstance(image, Image.Image):
        return read_rgb(image), None
    array = image.numpy(force=True) if is_tensor(image) else np.asarray(image)
    if is_tensor(image) and array.ndim == 3:
        array = np.moveaxis(array, 0, -1)
    if array.dtype == np.uint8 and array.shape[2:] == (3,):
        return np.ascontiguousarray(array), None
    raise SettingError(
        "image",
        found=f"{type(image).__name__} {tuple(np.shape(image))} of {array.dtype}",
        expected="RGB from 0 to 255: a uint8 tensor (3, H, W) or array (H, W, 3); a Pillow image; "
        "or the path of a file",
    )
