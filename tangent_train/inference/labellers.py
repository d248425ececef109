"""From the file of an image to its labels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from datamodules.core.panoramas import meters_to_steps, resize_nearest
from datamodules.images.gpano import area_of, area_of_crop, whole_area
from datamodules.images.gpano_pose import up_of
from datamodules.images.image_files import find_depth, photo_fov_deg, read_depth_m, read_rgb
from tangent_train.errors import DataError
from tangent_train.geometry import camera_matrix_from_fov
from tangent_train.inference.predictor import Done, InputImage
from tangent_train.inference.seams import seam_score
from tangent_train.inference.summary import class_shares
from tangent_train.rendering.upright.gravity import estimate_up

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from datamodules.core.panorama_module import Upright
    from datamodules.images.gpano import PanoramaArea
    from tangent_train.inference.panoramas import PanoramaPredictor
    from tangent_train.inference.photos import PhotoPredictor
    from tangent_train.rendering.mosaic import ScoreMosaic

__all__ = ["DepthFolder", "Labelled", "Labeller", "PanoramaLabeller", "PhotoLabeller"]

_ASPECT_TOLERANCE = 0.01
_NAMED = "Put depth into a folder of its own, with the names of the images."


@dataclass(frozen=True)
class Labelled:
    """One image and its labels.

    Attributes:
        rgb: ``(h, w, 3)`` the image.
        labels: ``(h, w)`` labels, 0 unknown.
        figures: Plain values about it, for the summary.
        mosaic: The scores, where probabilities were asked for.
        area: Where the image of a panorama lies on the sphere; None for photos.
    """

    rgb: NDArray[np.uint8]
    labels: NDArray[np.unsignedinteger]
    figures: dict[str, Any]
    mosaic: ScoreMosaic | None
    area: PanoramaArea | None = None


class Labeller(Protocol):
    """Labels image files of one kind."""

    def label(self, path: Path, name: str, done: Done, *, averaged: bool) -> Labelled:
        """Labels of one image.

        Args:
            path: Its file.
            name: Its path below the folder of all images, without suffix.
            done: Told of the progress.
            averaged: Whether probabilities will be asked for.

        Raises:
            DataError: The file cannot be used.
        """
        ...


@dataclass(frozen=True)
class DepthFolder:
    """Depth images named as the images they belong to, or with ``_depth`` at the end.

    Attributes:
        path: The folder.
        units_per_m: Of files with whole numbers.
    """

    path: Path
    units_per_m: float

    def read(self, name: str, shape: tuple[int, int]) -> NDArray[np.uint16]:
        """Depth of an image in steps of 1/512 m, 0 where missing, ``shape``.

        Args:
            name: Of the image, see `find_depth`.
            shape: Its rows and columns.

        Raises:
            DataError: There is none, it is broken, or it shows something of another form.
        """
        path = find_depth(self.path, name, _NAMED)
        depth_m = read_depth_m(path, self.units_per_m)
        height, width = depth_m.shape
        if abs(width * shape[0] / (height * shape[1]) - 1) > _ASPECT_TOLERANCE:
            raise DataError(
                path,
                found=f"{height}×{width} pixels",
                expected=f"the form of the image, which has {shape[0]}×{shape[1]}",
            )
        return meters_to_steps(resize_nearest(depth_m, shape))


@dataclass(frozen=True)
class PanoramaLabeller:
    """Labels panoramas, whole or a part of the sphere.

    Attributes:
        predictor: Labels whole ones.
        class_names: K + 1 names.
        crop: What all of them show, see `area_of_crop`; None for what they say themselves.
        depth: Their depth, for networks that take it.
        upright: Look at them upright: as they say themselves (``pose``), or else as estimated
            (``auto``); None for as they are.
        max_tilt_deg: Of estimates, see `estimate_up`.
    """

    predictor: PanoramaPredictor
    class_names: Sequence[str]
    crop: Sequence[float] | None = None
    depth: DepthFolder | None = None
    upright: Upright = None
    max_tilt_deg: float = 60.0

    def label(self, path: Path, name: str, done: Done, *, averaged: bool) -> Labelled:
        """Labels of one panorama; see `Labeller`."""
        rgb = read_rgb(path)
        size = (rgb.shape[0], rgb.shape[1])
        if self.crop is not None:
            area = area_of_crop(size, self.crop)
        else:
            area = area_of(path, size) or whole_area(path, size)
        depth = None if self.depth is None else area.place(self.depth.read(name, size))
        whole = area.place(rgb)
        image = InputImage(whole, depth, self._up(path, whole))
        prediction = self.predictor.predict(image, done, averaged=averaged)
        labels = prediction.mosaic.labels() + np.uint8(1)  # 0 is the unknown class
        if not area.is_whole:
            labels[~area.known] = 0
        figures: dict[str, Any] = {"level": prediction.level, "views": prediction.views}
        if prediction.grid is not None:
            seam = seam_score(labels, prediction.grid)
            figures |= {"seam_border": seam.border, "seam_inside": seam.inside}
            figures["seam_ratio"] = seam.ratio
        figures["classes"] = class_shares(labels, self.class_names)
        if image.up is not None:
            figures["tilt_deg"] = round(math.degrees(math.acos(np.clip(image.up[2], -1, 1))), 2)
        mosaic = prediction.mosaic if averaged else None  # 4·K bytes a pixel
        return Labelled(rgb, area.cut(labels), figures, mosaic, area)

    def _up(self, path: Path, rgb: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        if self.upright is None:
            return None
        known = up_of(path)
        if known is None and self.upright == "auto":
            return estimate_up(rgb, self.max_tilt_deg).found
        return known


@dataclass(frozen=True)
class PhotoLabeller:
    """Labels photos.

    Attributes:
        predictor: Labels them.
        class_names: K + 1 names.
        fov_deg: Horizontal field of view of all of them; None for what they say themselves.
        depth: Depth along their optical axes, for networks that take depth.
    """

    predictor: PhotoPredictor
    class_names: Sequence[str]
    fov_deg: float | None = None
    depth: DepthFolder | None = None

    def label(self, path: Path, name: str, done: Done, *, averaged: bool) -> Labelled:
        """Labels of one photo; see `Labeller`."""
        rgb = read_rgb(path)
        height, width = rgb.shape[:2]
        fov_deg = photo_fov_deg(path) if self.fov_deg is None else self.fov_deg
        if fov_deg is None:
            raise DataError(
                path,
                found="no focal length in its EXIF data",
                expected="the field of view, on which the size of things in the photo depends",
                remedy="Give fov=, the horizontal one in degrees: 65 to 80 for most telephones.",
            )
        camera_matrix = camera_matrix_from_fov(fov_deg, (height, width))
        depth = None if self.depth is None else self.depth.read(name, (height, width))
        prediction = self.predictor.predict(
            InputImage(rgb, depth), camera_matrix, done, averaged=averaged
        )
        labels = prediction.mosaic.labels() + np.uint8(1)  # 0 is the unknown class
        figures = {
            "level": prediction.level,
            "views": prediction.views,
            "fov_deg": fov_deg,
            "classes": class_shares(labels, self.class_names, camera_matrix),
        }
        mosaic = prediction.mosaic if averaged else None
        return Labelled(rgb, labels, figures, mosaic)
