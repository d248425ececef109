"""Images that Python code hands to a network: files, images in memory, tensors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from torch import Tensor

from datamodules.core.image_module import Upright
from datamodules.images.gpano import PanoramaArea, area_of_crop, whole_area
from datamodules.images.masks import Masks
from tangent_train.errors import SettingError
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.inference.images import read_panorama, read_photo
from tangent_train.inference.views import InputImage

Picture = str | Path | Image.Image | NDArray[Any] | Tensor
"""A file; an image of Pillow; or RGB of 0 to 255, an array ``(H, W, 3)`` or tensor ``(3, H, W)`` of
uint8 on any device."""

_NOT_WHOLE = (
    "Of a photo, give fov=, its horizontal field of view in degrees; of a part of a panorama, crop="
    "[west, east, south, north] in degrees."
)


def photo_of(image: Picture, fov: float) -> InputImage:
    """A photo with its horizontal field of view in degrees.

    Raises:
        DataError: A file cannot be used.
        SettingError: It is not an image.
    """
    if isinstance(image, str | Path):
        return read_photo(Path(image), Path(image).stem, fov_deg=fov)
    rgb = _rgb(image)
    return InputImage(rgb, camera_matrix=camera_matrix_from_fov(fov, (rgb.shape[0], rgb.shape[1])))


def panorama_of(
    image: Picture, crop: Sequence[float] | None, upright: Upright
) -> tuple[InputImage, PanoramaArea]:
    """A panorama: the whole sphere, black outside of the image's area, and that area.

    Args:
        image: The whole sphere or a part of it.
        crop: See `read_panorama`.
        upright: See `read_panorama`; of images in memory only ``auto``, which is left to `with_up`.

    Raises:
        DataError: A file cannot be used, or it is not the whole sphere.
        SettingError: It is not an image, or a setting does not suit it.
    """
    if isinstance(image, str | Path):
        path = Path(image)
        return read_panorama(path, path.stem, crop=crop, upright=upright)
    if upright == "pose":
        raise SettingError(
            "upright",
            found=f"pose, of {described(image)}",
            expected="auto or None: only files have GPano tags",
            remedy="Give the path of the panorama.",
        )
    rgb = _rgb(image)
    size = rgb.shape[0], rgb.shape[1]
    whole = whole_area(Path("panorama"), size, _NOT_WHOLE) if crop is None else None
    area = whole or area_of_crop(size, crop or ())
    return InputImage(area.place(rgb)), area


def counted_pixels(
    mask: Masks | NDArray[Any] | Tensor, image: Picture, area: PanoramaArea
) -> NDArray[np.bool_]:
    """Where the pixels of an image count, of its size.

    Args:
        mask: `Masks`; or of the image's size, 0 or False where they do not count.
        image: The image, whose name a folder of masks needs.
        area: Its part of the sphere.

    Raises:
        DataError: A mask cannot be used.
        SettingError: It is of another size, or there is no name.
    """
    if isinstance(mask, Masks):
        name = Path(image).stem if isinstance(image, str | Path) else ""
        if mask.of_each and not name:
            found = f"a folder, for {described(image)}"
            raise SettingError(
                "mask", found=found, expected="a file: an image in memory has no name"
            )
        return area.cut(mask.read(name, area)) > 0
    array = mask.detach().cpu().numpy() if isinstance(mask, Tensor) else mask
    if array.shape != area.image_shape:
        expected = "(H, W) of the image, {}, {}".format(*area.image_shape)
        raise SettingError("mask", found=described(mask), expected=expected)
    counted: NDArray[np.bool_] = array != 0
    return counted


def _rgb(image: Any) -> NDArray[np.uint8]:
    """An image ``(H, W, 3)``."""
    if isinstance(image, Image.Image):
        image = _pillow_rgb(image)
    is_tensor = isinstance(image, Tensor)
    array = image.detach().cpu().numpy() if is_tensor else image
    fits = isinstance(array, np.ndarray) and array.ndim == 3 and array.dtype == np.uint8
    channels = 0 if is_tensor else -1
    if fits and array.shape[channels] == 3 and array.size:
        return np.ascontiguousarray(np.moveaxis(array, channels, -1))
    raise SettingError(
        "image",
        found=described(image),
        expected="RGB of 0 to 255: a uint8 tensor (3, H, W) or array (H, W, 3); an image of "
        "Pillow; or the path of a file",
    )


def _pillow_rgb(image: Image.Image) -> NDArray[Any]:
    """The pixels of an image as `read_rgb` gives those of a file, upright and without alpha."""
    upright = ImageOps.exif_transpose(image)
    if upright.mode.startswith("I;16"):
        grey = (np.asarray(upright) >> 8).astype(np.uint8)
        return np.repeat(grey[..., None], 3, axis=-1)
    if upright.mode in ("I", "F"):
        found = f"an image of Pillow with the mode {upright.mode}"
        raise SettingError("image", found=found, expected="colours of 8 or 16 bits")
    upright.info.pop("transparency", None)  # Pillow warns that RGB loses it
    return np.asarray(upright.convert("RGB"))


def described(value: Any) -> str:
    """Kind, shape and type of a value, for messages."""
    if value is None:
        return "none"
    kind = type(value).__name__
    return f"{kind} {tuple(value.shape)} of {value.dtype}" if hasattr(value, "dtype") else kind
