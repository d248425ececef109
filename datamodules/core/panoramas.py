"""Panoramas and photos of any data set: their files, decoding, sizes and unknown pixels.

RGB, depth and labels of a panorama are resized to the size that a run reads on **one** pixel
grid: the outer edges of source and target agree, so target row i covers source rows
``i · H / h`` to ``(i + 1) · H / h``. RGB is averaged over that area; labels and depth are taken
from the source pixel at its center.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from datamodules.core.labels import DISTANCE, ClassSet
from datamodules.core.problems import Problems
from datamodules.core.store import Declared, Layout
from tangent_train.errors import DataError, width_height
from tangent_train.geometry import PanoramaPose, ray_lengths
from tangent_train.io.pixel_files import read_rgb
from tangent_train.io.png import check_png
from tangent_train.orientation.gravity import upright_rotation
from tangent_train.rendering.resampling import resize

if TYPE_CHECKING:
    from tangent_train.rendering.representations.perspective import (
        PerspectiveRepresentation,
        PhotoSampler,
    )
    from tangent_train.rendering.representations.views import Representation, Sampler


_Pixel = TypeVar("_Pixel", bound=np.generic)

Labels = NDArray[np.unsignedinteger[Any]]
"""Labels ``(H, W)``, 0 where unknown: uint8 classes, or uint16 distances in steps of 1/512 m."""

Unknown = Literal["labels", "any_black", "all_black"]
"""Pixels that are unknown in addition to unlabeled pixels; see `mask_black`."""

TestRotation = float | Literal["so3"] | None
"""Rotation of test panoramas: a tilt in degrees, uniformly random (SO(3)), or null."""

STEPS_PER_M = 512
"""Steps of depth per meter, as in the files of Stanford2D3DS."""


_MOST_STEPS = np.iinfo(np.uint16).max
_USUAL_M = (0.05, 100)  # median distances; others are probably in other units


class ImageFiles(NamedTuple):
    """The files of one panorama or photo.

    Attributes:
        name: Unique short name; ``/`` between groups.
        rgb: Color image.
        labels: File of class labels; None if the labels are distances.
        depth: Depth image, if depth is an input or the labels are distances.
        camera: File with the camera matrix, for photos with one file each.
    """

    name: str
    rgb: Path
    labels: Path | None
    depth: Path | None = None
    camera: Path | None = None

    @property
    def parts(self) -> dict[str, Path]:
        """Files of the image by content."""
        return {part: path for part, path in self._asdict().items() if part != "name" and path}


class ImageReader(ABC):
    """Decoder of the files of a data set."""

    @property
    def settings(self) -> Mapping[str, str]:
        """Everything that affects labels and depth besides the files, such as a class table.

        Each combination has a separate prepared store; by default there are no settings.
        """
        return {}

    @abstractmethod
    def size(self, part: str, path: Path) -> tuple[int, int] | None:
        """Return rows and columns from the header of a file in the data set's format.

        Args:
            part: ``rgb``, ``labels`` or ``depth``.
            path: File, which must be complete.

        Returns:
            None for labels that are not stored as pixels, but drawn at any size.

        Raises:
            DataError: The file is broken or has another format.
        """

    @abstractmethod
    def rgb(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Return the colors, ``(H, W, 3)`` uint8."""

    @abstractmethod
    def labels(self, files: ImageFiles, shape: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Return the labels, 0 where unknown.

        Args:
            files: Files of the image.
            shape: ``(h, w)`` of the result, see `resize_nearest`; by default the size of the file.

        Raises:
            DataError: The file is broken, or contains a value that is not a class.
        """

    def label_warning(self, files: ImageFiles) -> str:
        """Return a warning about usable labels, or an empty string."""
        del files
        return ""

    def depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Return depth ``(H, W)`` in steps of 1/512 m, 0 where missing; z-depth for photos."""
        raise NotImplementedError(files.name)

    def camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """Return ``(3, 3)`` K of a photo for integer pixel centers, without skew."""
        raise NotImplementedError(files.name)

    def pose(self, files: ImageFiles) -> PanoramaPose | None:
        """Return the pose in meters, see `LabeledImage`; None if unknown."""
        del files
        return None


class PngReader(ImageReader):
    """Decoder of the PNG files of a release.

    Attributes:
        formats: Bits per channel and allowed color types (`PngHeader.color`), by part.
    """

    formats: Mapping[str, tuple[int, Sequence[str]]]

    def size(self, part: str, path: Path) -> tuple[int, int]:
        """See `ImageReader`."""
        header = check_png(path, *self.formats[part])
        return header.height, header.width

    def rgb(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Return the colors without alpha."""
        return read_rgb(files.rgb)


class Panorama(NamedTuple):
    """One panorama.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        depth: ``(H, W)`` uint16 distance from the center in steps of 1/512 m, 0 where missing; None
            if not read. See `steps_to_meters`.
        labels: ``(H, W)`` uint8 classes, 0 where unknown; or distances like `depth`, which is then
            None, see `PanoramaDistances`.
        up: ``(3,)`` direction of the zenith, a unit vector; None if it is z (upright).
        valid: ``(H, W)`` bool, the recorded pixels; None if all are. Elsewhere, labels and depth
            are 0, and colors are filled.

    The arrays may be shared or read-only: not to be written to.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None
    labels: Labels
    up: NDArray[np.float64] | None = None
    valid: NDArray[np.bool_] | None = None

    def sampler(self, representation: Representation) -> Sampler:
        """Return the sampler of its views, aligned with gravity."""
        if self.up is None:
            return representation
        return representation.with_rotation(upright_rotation(self.up))

    def target(self, representation: Representation) -> Labels:
        """Return the labels that predictions on the panorama are compared with: all of them."""
        del representation
        return self.labels


def resize_area(image: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Downsample ``(H, W, 3)`` to ``shape`` by area averaging."""
    return resize(image, shape, "bilinear")


def resize_nearest(image: NDArray[_Pixel], shape: tuple[int, int]) -> NDArray[_Pixel]:
    """Downsample ``(H, W[, C])`` to ``shape``: the pixel at the center of each target pixel.

    Where the center is a corner of four pixels (even ratios), the lower right pixel is taken.
    """
    resized: Any = resize(image, shape, "nearest")
    return resized


def resize_depth(depth: NDArray[np.uint16], shape: tuple[int, int]) -> NDArray[np.uint16]:
    """Downsample raw depth ``(H, W)``, 0 where missing, without mixing values.

    Like `resize_nearest`, but where the center pixel is missing, the nearest valid pixel within
    the area of the target pixel is taken.
    """
    small = resize_nearest(depth, shape)
    holes = np.nonzero(small == 0)
    scale = [source / target for source, target in zip(depth.shape, shape, strict=True)]
    centers = [(i + 0.5) * s for i, s in zip(holes, scale, strict=True)]
    # The first source pixel whose center lies in the area of the target pixel.
    first = [np.ceil(i * s - 0.5).astype(np.intp) for i, s in zip(holes, scale, strict=True)]
    nearest = np.full(len(holes[0]), np.inf)
    for step in np.ndindex(math.ceil(scale[0]), math.ceil(scale[1])):
        pixel = [np.minimum(f + d, n - 1) for f, d, n in zip(first, step, depth.shape, strict=True)]
        away = [np.abs(p + 0.5 - c) for p, c in zip(pixel, centers, strict=True)]
        inside = (away[0] <= scale[0] / 2) & (away[1] <= scale[1] / 2)
        distance = np.hypot(*away)
        value = depth[pixel[0], pixel[1]]
        better = inside & (value > 0) & (distance < nearest)
        small[holes[0][better], holes[1][better]] = value[better]
        nearest[better] = distance[better]
    return small


def mask_black(labels: Labels, rgb: NDArray[np.uint8], unknown: Unknown) -> Labels:
    """Make black pixels unknown.

    The paper's released code applies `any_black` in training and evaluation, before resizing. This
    function does the same at the pixels that the labels are taken from.

    Args:
        labels: ``(H, W)``.
        rgb: ``(H, W, 3)`` at the same pixels.
        unknown: `labels` changes nothing; `any_black` makes pixels unknown where any channel is 0;
            `all_black` where all channels are 0.

    Returns:
        ``(H, W)`` labels.
    """
    if unknown == "labels":
        return labels
    black = rgb == 0
    return np.where(black.any(-1) if unknown == "any_black" else black.all(-1), np.uint8(0), labels)


def steps_to_meters(steps: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Convert depth in steps of 1/512 m to meters, float32, NaN where missing."""
    meters = steps.astype(np.float32) / np.float32(STEPS_PER_M)
    return np.where(steps == 0, np.float32(np.nan), meters)


def meters_to_steps(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert depth in meters to steps of 1/512 m, rounded, at most 65535 (128 m).

    Depth below half a step is rounded up to one step: 0 means missing.

    >>> meters_to_steps(np.array([0, 1e-4, 1, 1000], np.float32)).tolist()
    [0, 1, 512, 65535]
    """
    steps = np.minimum(depth_m * np.float32(STEPS_PER_M) + np.float32(0.5), _MOST_STEPS)
    return np.maximum(steps.astype(np.uint16), depth_m > 0)


def units_to_steps(stored: NDArray[np.uint16], units_per_m: int) -> NDArray[np.uint16]:
    """Convert 16-bit depth in integer units to steps of 1/512 m, see `meters_to_steps`.

    >>> units_to_steps(np.array([0, 1, 4000, 65535], np.uint16), 4000).tolist()
    [0, 1, 512, 8388]
    """
    # In integers, because float32 would round some values of 16 bits to the wrong step.
    steps = (stored.astype(np.int64) * 2 * STEPS_PER_M + units_per_m) // (2 * units_per_m)
    return np.maximum(np.minimum(steps, _MOST_STEPS).astype(np.uint16), stored > 0)


class Photo(NamedTuple):
    """One pinhole image.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        depth: ``(H, W)`` uint16 distance from the center of projection, as in panoramas, in steps
            of 1/512 m, 0 where missing; None if not read. See `distance_from_z_depth`.
        labels: Classes or distances, as in panoramas.
        camera_matrix: ``(3, 3)`` K for integer pixel centers, without skew.
        up: None; the up direction of a photo is unknown.
        valid: None; all pixels of a photo are valid.

    The arrays may be shared or read-only: not to be written to.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.uint16] | None
    labels: Labels
    camera_matrix: NDArray[np.float64]
    up: None = None
    valid: None = None

    def sampler(self, representation: PerspectiveRepresentation) -> PhotoSampler:
        """Return the sampler of its crops, which depend on its camera."""
        height, width = self.labels.shape
        return representation.of_camera(self.camera_matrix, (height, width))

    def target(self, representation: PerspectiveRepresentation) -> Labels:
        """Return ``(n, d, d)`` labels of the crops; every pixel of the photo is in one crop."""
        (crops,) = self.sampler(representation).view_sets()
        return np.where(crops.owned(), crops.render(self.labels, "nearest"), np.uint8(0))


def distance_from_z_depth(
    z_depth: NDArray[np.uint16], camera_matrix: NDArray[np.float64]
) -> NDArray[np.uint16]:
    """Convert z-depth to the distance from the center of projection, as in panoramas.

    Args:
        z_depth: ``(H, W)`` depth along the optical axis in any unit, 0 where missing.
        camera_matrix: ``(3, 3)`` K for integer pixel centers.

    Returns:
        ``(H, W)`` in the same unit, rounded, at most 65535; 0 where missing.
    """
    lengths = ray_lengths(camera_matrix, z_depth.shape)
    return np.minimum(z_depth * lengths + 0.5, _MOST_STEPS).astype(np.uint16)


@dataclass(frozen=True)
class _Reading:
    """Reads the images of a data set.

    Attributes:
        reader: Reader of the data set.
        num_classes: K + 1, including the unknown class.
        shape: Rows and columns of the result, of the area that the files show; None for the size
            of the files.
        class_set: Classes of the result; None for the classes of the reader.
        unknown: Black pixels that are unknown, see `mask_black`.
        kind: Named tuple that is returned, `Panorama` or `Photo`.
    """

    reader: ImageReader
    num_classes: int
    shape: tuple[int, int] | None = None
    class_set: ClassSet | None = None
    unknown: Unknown = "labels"
    kind: ClassVar[type[Panorama | Photo]]

    @property
    def store_name(self) -> str:
        """Name of the images in a store."""
        return "photos" if self.shape is None else "{}x{}".format(*self.shape)

    @property
    def settings(self) -> Mapping[str, str]:
        """See `ImageReader`; also classes and black pixels."""
        further = {"classes": repr(self.class_set), "unknown": self.unknown}
        return {**self.reader.settings, **further}

    @property
    def layout(self) -> Layout:
        """Arrays of an image in a store."""
        height, width = self.shape or ("H", "W")
        return {
            "rgb": Declared("uint8", (height, width, 3)),
            "depth": Declared("uint16", (height, width)),
            "labels": Declared("uint8", (height, width), self.num_classes - 1),
        }

    def distances(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Return distances from the center in steps of 1/512 m, 0 where missing."""
        depth = self.reader.depth(files)
        return depth if self.shape is None else resize_depth(depth, self.shape)

    def depth(self, files: ImageFiles) -> NDArray[np.uint16] | None:
        """Return the distances if depth is an input."""
        return None if files.depth is None else self.distances(files)

    def labels(self, files: ImageFiles) -> Labels:
        """Return only the labels."""
        labels = self.stored_labels(files)
        if self.unknown == "labels":
            return labels
        rgb = self.reader.rgb(files)
        rgb = rgb if self.shape is None else resize_nearest(rgb, self.shape)
        return mask_black(labels, rgb, self.unknown)

    def stored_labels(self, files: ImageFiles) -> Labels:
        """Return the labels of the files, checked against the number of classes."""
        labels = self.reader.labels(files, self.shape)
        labels = labels if self.class_set is None else self.class_set.relabel(labels)
        if labels.max(initial=0) >= self.num_classes:
            raise DataError(
                files.labels,
                found=f"label {labels.max()}",
                expected=f"0 (unknown) to {self.num_classes - 1}",
                remedy="The data set's class_names and its reader's labels have to agree.",
            )
        return labels

    def parts(
        self, label_counts: dict[str, NDArray[np.int64]], warnings: list[str]
    ) -> dict[str, Callable[[ImageFiles], object]]:
        """Return functions that decode one file of an image, by part.

        Args:
            label_counts: Collects the number of pixels of each label by name of the image.
            warnings: Collects warnings about labels.
        """

        def count_labels(files: ImageFiles) -> None:
            labels = replace(self, shape=None).labels(files)
            label_counts[files.name] = np.bincount(labels.ravel(), minlength=self.num_classes)
            if warning := self.reader.label_warning(files):
                warnings.append(warning)

        reader = self.reader
        parts = {"rgb": reader.rgb, "depth": reader.depth, "camera": reader.camera}
        return {"labels": count_labels, **parts}


class PanoramaReading(_Reading):
    """Reads panoramas, all at the same size."""

    kind = Panorama

    def __call__(self, files: ImageFiles) -> Panorama:
        """Read one panorama."""
        shape: Any = self.shape
        rgb = resize_area(self.reader.rgb(files), shape)
        return Panorama(rgb, self.depth(files), self.labels(files))


class PhotoReading(_Reading):
    """Reads photos; z-depth becomes distance from the center of projection."""

    kind = Photo

    @property
    def layout(self) -> Layout:
        """See `PanoramaReading`."""
        return {**super().layout, "camera_matrix": Declared("float64", (3, 3))}

    def __call__(self, files: ImageFiles) -> Photo:
        """Read one photo."""
        camera_matrix, rgb = self.reader.camera(files), self.reader.rgb(files)
        return Photo(rgb, self.depth(files), self.labels(files), camera_matrix)

    def distances(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Return distances, of which the files hold z-depth."""
        return distance_from_z_depth(self.reader.depth(files), self.reader.camera(files))


class _DistanceLabels(_Reading):
    """Reads images whose labels are distances; depth is not an input then."""

    @property
    def settings(self) -> Mapping[str, str]:
        """See `ImageReader`."""
        return {**super().settings, "labels": DISTANCE}

    @property
    def layout(self) -> Layout:
        """Arrays of an image in a store."""
        layout = dict(super().layout)
        depth = layout.pop("depth")
        return {**layout, "labels": depth}

    def depth(self, files: ImageFiles) -> None:
        """Return None."""
        del files

    def stored_labels(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Return the distances, 0 where missing and from 128 m, which 16 bits cannot hold."""
        steps = self.distances(files)
        return np.where(steps < _MOST_STEPS, steps, np.uint16(0))

    def parts(
        self, label_counts: dict[str, NDArray[np.int64]], warnings: list[str]
    ) -> dict[str, Callable[[ImageFiles], object]]:
        """Return functions that decode one file of an image, by part.

        Args:
            label_counts: Collects the number of pixels without and with a distance.
            warnings: Collects warnings about units.
        """

        def count_distances(files: ImageFiles) -> None:
            steps = replace(self, shape=None).labels(files)
            known = steps[steps > 0]
            label_counts[files.name] = np.array([steps.size - known.size, known.size])
            median_m = np.median(known) / STEPS_PER_M if known.size else 0
            found = f"median distance {median_m:.3g} m" if median_m else "no distance below 128 m"
            if not _USUAL_M[0] <= median_m <= _USUAL_M[1]:
                warnings.append(f"{files.depth}: {found}; check the units and the missing value.")

        return {**super().parts(label_counts, warnings), "depth": count_distances}


class PanoramaDistances(_DistanceLabels, PanoramaReading):
    """Reads panoramas with distances as labels, see `DISTANCE`."""


class PhotoDistances(_DistanceLabels, PhotoReading):
    """Reads photos with distances as labels, see `DISTANCE`."""


def check_headers(
    files: ImageFiles,
    reader: ImageReader,
    problems: Problems,
    check_size: Callable[[Path, tuple[int, int]], None] = lambda path, size: None,
) -> tuple[int, int] | None:
    """Check, without decoding, that the files of an image are complete and have one size.

    Args:
        files: Files of the image.
        reader: Reader of the data set.
        problems: Collects problems under the image's name.
        check_size: Function that refuses rows and columns of a color image.

    Returns:
        Rows and columns; None if the color image cannot be used.
    """
    size: tuple[int, int] | None = None
    for part in ("rgb", "labels", "depth"):
        path: Any = getattr(files, part)
        if path is None:
            continue
        with problems.noted(files.name, path):
            found = reader.size(part, path)
            if found is None:
                continue
            if part == "rgb":
                size = found
                check_size(path, found)
            elif size not in (None, found):
                remedy = "Export or copy both at one size."
                if found[::-1] == size:
                    remedy = "Export it as the image is displayed, rotated as its EXIF data say."
                raise DataError(
                    path,
                    found=width_height(found),
                    expected=f"{width_height(size)}, as {files.rgb}" if size else "",
                    remedy=remedy,
                )
    return size
