"""Base data modules of labeled images, and of photos."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveInt
from torch import Tensor

from datamodules.core.data_module import DataModule, data_set
from datamodules.core.dataset import ImageDataset
from datamodules.core.images import (
    MOST_STEPS,
    STEPS_PER_M,
    Image,
    ImageFiles,
    Labels,
    Unknown,
    distance_from_z_depth,
    mask_black,
    resize_depth,
    units_to_steps,
)
from datamodules.core.inputs import (
    RGB_NORMALIZATION,
    RGBD_NORMALIZATION,
    Input,
    Normalization,
    channel_names,
    normalize,
    ordered_inputs,
)
from datamodules.core.label_map import UNKNOWN_NAME, LabelMap
from datamodules.core.labels import DISTANCE, PIXEL_CLASSES
from datamodules.core.splits import SPLITS, Split
from tangent_train.errors import DataError, SettingError, width_height
from tangent_train.geometry import PanoramaPose, shift_range
from tangent_train.io.pixel_files import read_image_size, read_pixels, read_rgb
from tangent_train.rendering import PerspectiveRepresentation
from tangent_train.rendering.resampling import resize

_USUAL_M = (0.05, 100)  # median distances; others are probably in other units


@data_set
class ImageDataModule(DataModule):
    """Labeled panoramas or photos of one data set.

    A subclass lists the files of its splits (`files`) and names the classes (`label_maps`). If its
    label images, depth or cameras are stored in another way than here, it also overrides
    `decode_labels`, `decode_depth` or `decode_camera`, or `decode` as a whole.

    Args:
        labels: `pixel_classes`, or `distance`: depth files give the labels, and there are no
            classes, see `DISTANCE`.
        inputs: Inputs of the network, `rgb` and optionally others, see `Input`.
        color_jitter: Strength of the color augmentation, 0 (none) to 1, see `jitter_colors`.
        classes: Name of one of the `label_maps`; None for the first.
        unknown: Black pixels that are unknown too, see `mask_black`.

    Attributes:
        normalizations: Default normalizations, without and with depth.
        label_maps: Label map of each set of classes, by its name.
        units_per_m: Units of 16-bit depth files in a meter.
        no_depth: Reason why depth cannot be an input; empty if it can.
        no_distances: Reason why distances cannot be the labels, besides `no_depth`.
        label_map: Label map of the chosen classes; None if the labels are distances.
    """

    kind = Image
    normalizations: ClassVar[tuple[Normalization, Normalization]] = (
        RGB_NORMALIZATION,
        RGBD_NORMALIZATION,
    )
    label_maps: ClassVar[Mapping[str, LabelMap]] = {}
    units_per_m: ClassVar[int] = STEPS_PER_M
    no_depth: ClassVar[str] = ""
    no_distances: ClassVar[str] = ""
    fact_settings: ClassVar[tuple[str, ...]] = ("unknown",)

    labels: Literal["pixel_classes", "distance"] = "pixel_classes"  # type: ignore[misc]
    inputs: Sequence[Input] = ("rgb", "depth")
    color_jitter: Annotated[float, Field(ge=0, le=1)] = 0.0
    classes: str | int | None = None
    unknown: Unknown = "labels"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.inputs = ordered_inputs(self.inputs)
        with_depth = "depth" in self.inputs
        if self.has_distances and (self.no_depth or self.no_distances):
            reason = f"{PIXEL_CLASSES}: {self.no_depth or self.no_distances}"
            raise SettingError("data.labels", found=DISTANCE, expected=reason)
        if self.has_distances and self.classes is not None:
            raise SettingError("data.classes", found=self.classes, expected="null, with distances")
        if with_depth and (self.no_depth or self.has_distances):
            expected = f"no depth: {self.no_depth or 'it is the target'}"
            raise SettingError("data.inputs", found=list(self.inputs), expected=expected)
        self.label_map = None if self.has_distances else self.find_label_map()
        if self.label_map is not None:
            self.class_names = (UNKNOWN_NAME, *self.label_map.names)  # type: ignore[misc]
        given = self.normalization or self.normalizations[with_depth]
        self.normalization = Normalization.of(given, 3 + with_depth, "data.normalization")

    def find_label_map(self) -> LabelMap:
        """Return the label map of the setting `classes`.

        Raises:
            SettingError: There is no such set of classes.
        """
        name = next(iter(self.label_maps)) if self.classes is None else str(self.classes)
        if name not in self.label_maps:
            expected = " or ".join(self.label_maps)
            raise SettingError("data.classes", found=name, expected=expected)
        return self.label_maps[name]

    @property
    def has_distances(self) -> bool:
        """True if the labels are distances."""
        return self.labels == DISTANCE

    @property
    def reads_depth(self) -> bool:
        """True if depth files are read, as input or labels."""
        return self.has_distances or "depth" in self.inputs

    @property
    def read_shape(self) -> tuple[int, int] | None:
        """Rows and columns to which images are resized; None for the size of the files."""
        return None

    # --- decoding, which data sets may override ------------------------------------------------

    @abstractmethod
    def files(self, split: Split) -> Sequence[ImageFiles]:
        """See `DataModule`; depth files are among them if the data set `reads_depth`."""

    def decode(self, files: ImageFiles) -> Image:
        """Decode the files of an image, at any size; z-depth of photos."""
        labels: Any = None if files.labels is None else self.decode_labels(files)
        depth = None if files.depth is None else self.decode_depth(files)
        return Image(read_rgb(files.rgb), depth, labels, camera_matrix=self.decode_camera(files))

    def decode_labels(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Return the labels of an image."""
        label_map: Any = self.label_map
        labels: NDArray[np.uint8] = label_map.read_labels(files.labels)
        return labels

    def decode_depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Return depth in steps of 1/512 m, 0 where missing."""
        path: Any = files.depth
        stored = read_pixels(path, indices=True)
        if stored.dtype != np.uint16 or stored.ndim > 2:
            raise DataError(path, found=f"{stored.dtype} {stored.shape}", expected="16-bit gray")
        return units_to_steps(stored, self.units_per_m)

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64] | None:
        """Return ``(3, 3)`` K of a photo for integer pixel centers; None for a panorama."""
        del files
        return None

    def pose(self, files: ImageFiles) -> PanoramaPose | None:
        """Return the pose of an image, before any rotation; None if unknown.

        In a photo's axes, x is the optical axis, y points to the right and z up in the image.
        """
        del files
        return None

    # --- reading -------------------------------------------------------------------------------

    def read(self, files: ImageFiles) -> Image:
        """See `DataModule`: the image at its size in training, with its labels or distances."""
        rgb, depth, labels, *_, matrix = self.decode(files)
        shape, near = self.read_shape, rgb
        if depth is not None and matrix is not None:
            depth = distance_from_z_depth(depth, matrix)
        if shape is not None:
            near = rgb if self.unknown == "labels" else resize(rgb, shape, "nearest")
            rgb = resize(rgb, shape, "bilinear")
            depth = None if depth is None else resize_depth(depth, shape)
            labels = labels if labels is None else resize(labels, shape, "nearest")
        if self.has_distances and depth is not None:
            # From 128 m, 16 bits do not hold the distance.
            labels, depth = np.where(depth < MOST_STEPS, depth, np.uint16(0)), None
        labels = mask_black(labels, near, self.unknown)
        return Image(rgb, depth, labels, camera_matrix=matrix)

    def read_labels(self, files: ImageFiles) -> Labels:
        """Return only the labels of `read`."""
        if self.has_distances or self.unknown != "labels":
            return self.read(files).labels
        labels, shape = self.decode_labels(files), self.read_shape
        return labels if shape is None else resize(labels, shape, "nearest")

    def _find_files(self) -> dict[Split, list[Any]]:
        found = super()._find_files()
        if self.has_distances:
            found = {split: [f._replace(labels=None) for f in found[split]] for split in SPLITS}
        return found

    def check_files(self, files: ImageFiles) -> None:
        """See `DataModule`: the files of an image are complete and have one size."""
        size = read_image_size(files.rgb)
        self.check_size(files, size)
        for path in (files.labels, files.depth):
            if path is not None and path.suffix != ".json":
                found = read_image_size(path)
                if found != size:
                    expected = f"{width_height(size)}, as {files.rgb}"
                    raise DataError(path, found=width_height(found), expected=expected)

    def check_size(self, files: ImageFiles, size: tuple[int, int]) -> None:
        """Refuse an image whose rows and columns do not suit the settings."""

    def decode_settings(self) -> dict[str, Any]:
        """See `DataModule`."""
        settings = {"shape": self.read_shape, "unknown": self.unknown, "labels": self.labels}
        return {**super().decode_settings(), **settings, "label map": repr(self.label_map)}

    def count_labels(self, item: Image) -> NDArray[np.int64]:
        """See `DataModule`: classes, or pixels without and with a distance."""
        if self.has_distances:
            known = np.count_nonzero(item.labels)
            return np.array([item.labels.size - known, known])
        return np.bincount(item.labels.ravel(), minlength=len(self.class_names))

    def warning(self, files: ImageFiles, item: Image) -> str:
        """See `DataModule`: of distances that are probably in other units."""
        if not self.has_distances:
            return ""
        known = item.labels[item.labels > 0]
        median_m = np.median(known) / STEPS_PER_M if known.size else 0
        if _USUAL_M[0] <= median_m <= _USUAL_M[1]:
            return ""
        found = f"median distance {median_m:.3g} m" if median_m else "no distance below 128 m"
        return f"{files.depth}: {found}; check the units and the missing value."

    # --- samples -------------------------------------------------------------------------------

    def build_dataset(self, split: Split) -> ImageDataset:
        """See `DataModule`: samples `TrainingSample` or `EvaluationSample`."""
        return ImageDataset(self, split)

    @property
    def in_channels(self) -> int:
        """Total channels of all inputs."""
        return len(channel_names(self.inputs))

    def normalized(self, batch: Any) -> Tensor:
        """See `DataModule`."""
        return normalize(batch.images, self.normalization, self.inputs)


def check_representation(data: DataModule, attribute: str, choice: str) -> None:
    """Refuse a representation that is made for another kind of images.

    Args:
        data: The data module.
        attribute: Attribute that all suitable representations have.
        choice: Name of a suitable representation, for the error message.

    Raises:
        SettingError: The representation is not suitable.
    """
    if not hasattr(data.representation, attribute):
        found, expected = type(data.representation).__name__, f"one for {data.noun}"
        remedy = f"Choose representation={choice}, or other data."
        raise SettingError("representation", found=found, expected=expected, remedy=remedy)


@data_set
class PhotoDataModule(ImageDataModule):
    """Labeled photos of one data set, see `ImageDataModule`.

    The representation is the camera to which all photos are normalized. A subclass defines
    `decode_camera`.

    Args:
        batch_size: Photos per training step and process. Evaluation takes one at a time.
    """

    noun: ClassVar[str] = "photos"
    fact_settings: ClassVar[tuple[str, ...]] = ("size",)

    batch_size: PositiveInt = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        check_representation(self, "of_camera", "perspective")
        if "elevation" in self.inputs:
            expected = "no elevation: the horizon of a photo is unknown"
            raise SettingError("data.inputs", found=list(self.inputs), expected=expected)

    @property
    def size(self) -> str:
        """Size of the crops that are scored, which cover all pixels of a photo."""
        height, width = self.representation.image_size
        return f"crops of {self.representation.fov_deg:g}° in {width} × {height}"

    def default_representation(self) -> PerspectiveRepresentation:
        """Crops of 45° at the resolution of level 7."""
        return PerspectiveRepresentation(7 if self.level is None else self.level)

    def check_size(self, files: ImageFiles, size: tuple[int, int]) -> None:
        """See `ImageDataModule`: the crops fit into the photo."""
        camera: Any = self.decode_camera(files)
        fov_deg, (_, columns) = self.representation.fov_deg, self.representation.image_size
        try:
            shift_range(camera, size, fov_deg, self.representation.image_size)
        except SettingError as error:
            rows = int(size[0] / 2 / (camera[1, 1] * math.tan(math.radians(fov_deg) / 2)) * columns)
            # A setting: if it fits none of the photos, it is refused once.
            raise SettingError(
                "representation.fov_deg",
                found=f"{error.found}, {files.rgb}",
                expected=f"all of a crop of {fov_deg:g}°",
                remedy="Lower it, make the crops less high with "
                f"representation.dim=[{rows},{columns}] or fewer rows, or remove the photo.",
            ) from error
