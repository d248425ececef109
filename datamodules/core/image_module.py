"""Bases of data sets of labeled images: panoramas, and photos."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PositiveInt
from torch import Tensor
from torch.utils.data import DataLoader

from datamodules.core.data_module import DataModule, data_set
from datamodules.core.dataset import Image, ImageDataset, Labels, draw_rotation
from datamodules.core.depth import (
    MOST_STEPS,
    STEPS_PER_M,
    distance_from_z_depth,
    meters_to_steps,
    resize_depth,
)
from datamodules.core.files import ImageFiles, Split
from datamodules.core.inputs import (
    INPUTS,
    RGB_NORMALIZATION,
    RGBD_NORMALIZATION,
    Input,
    Normalization,
    channel_names,
    normalize,
)
from datamodules.core.label_map import DISTANCE, PANOPTIC, PIXEL_CLASSES, UNKNOWN_NAME, LabelMap
from tangent_train.errors import DataError, width_height
from tangent_train.geometry import PanoramaPose, shift_range
from tangent_train.geometry.sphere import check_area
from tangent_train.io.gpano import (
    Fill,
    PanoramaArea,
    black_outside,
    check_resolution,
    read_area,
    read_up,
)
from tangent_train.io.masks import Masks
from tangent_train.io.pixel_files import read_depth_m, read_image_size, read_rgb
from tangent_train.kinds import Upright
from tangent_train.metrics.panoptic import LABEL
from tangent_train.orientation.gravity import estimate_up
from tangent_train.orientation.manhattan import MOST_ROWS
from tangent_train.progress import show_progress
from tangent_train.rendering import (
    PerspectiveRepresentation,
    rotate_equirect,
)
from tangent_train.rendering.resampling import resize

Unknown = Literal["labels", "any_black", "all_black"]
"""Pixels that are unknown in addition to unlabeled pixels; see `mask_black`."""

TestRotation = Annotated[float, Field(ge=0, le=180)] | Literal["so3"] | None
"""Rotation of test panoramas: a tilt in degrees, uniformly random (SO(3)), or null."""

PanoramaJudge = Callable[[Image, "NDArray[np.float64]"], "NDArray[np.float64]"]
"""Returns log-likelihoods ``(n,)`` that directions ``(n, 3)`` of a panorama are up."""

_USUAL_M = (0.05, 100)  # median distances; others are probably in other units


@data_set
class ImageDataModule(DataModule):
    """Labeled panoramas or photos of one data set.

    A subclass lists the files of its splits (`files`) and names the classes (`label_maps`). If its
    label images, depth or cameras are stored in another way than here, it also overrides
    `decode_labels`, `decode_depth` or `decode_camera`, or `decode` as a whole.

    Args:
        labels: `pixel_classes`, or `distance`: depth files give the labels, and there are no
            classes, see `DISTANCE`. `panoptic`: classes and objects, see `PANOPTIC`.
        inputs: Inputs of the network, `rgb` and optionally others, see `Input`.
        color_jitter: Strength of the color augmentation, 0 (none) to 1, see `jitter_colors`.
        classes: Name of one of the `label_maps`; None for the first.
        unknown: Black pixels that are unknown too, see `mask_black`.

    Attributes:
        normalizations: Default normalizations, without and with depth.
        label_maps: Label map of each set of classes, by its name.
        things: Names of the classes whose objects are numbered in the label files.
        units_per_m: Units of 16-bit depth files in a meter.
        no_depth: Reason why depth cannot be an input; empty if it can.
        no_distances: Reason why distances cannot be the labels, besides `no_depth`.
        label_map: Label map of the chosen classes; None if the labels are distances.
    """

    kind = Image
    samples = ImageDataset
    normalizations: ClassVar[tuple[Normalization, Normalization]] = (
        RGB_NORMALIZATION,
        RGBD_NORMALIZATION,
    )
    label_maps: ClassVar[Mapping[str, LabelMap]] = {}
    things: ClassVar[Sequence[str]] = ()
    units_per_m: ClassVar[int] = STEPS_PER_M
    no_depth: ClassVar[str] = ""
    no_distances: ClassVar[str] = ""
    fact_settings: ClassVar[tuple[str, ...]] = ("unknown",)
    cache_settings: ClassVar[tuple[str, ...]] = ("read_shape", "unknown", "labels", "label_map")

    labels: Literal["pixel_classes", "distance", "panoptic"] = "pixel_classes"  # type: ignore[misc]
    inputs: Sequence[Input] = ("rgb",)
    color_jitter: Annotated[float, Field(ge=0, le=1)] = 0.0
    classes: str | int | None = None
    unknown: Unknown = "labels"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.inputs = tuple(name for name in INPUTS if name in self.inputs)
        with_depth, distances = "depth" in self.inputs, self.has_distances
        no_labels, no_depth = self.no_depth or self.no_distances, self.no_depth
        self.refuse("labels", distances and no_labels, f"{PIXEL_CLASSES}: {no_labels}")
        expected = f"{PIXEL_CLASSES}: the label files do not number objects"
        self.refuse("labels", self.labels == PANOPTIC and not self.things, expected)
        self.refuse("classes", distances and self.classes is not None, "null, with distances")
        no_depth = "it is the target" if distances else no_depth
        self.refuse("inputs", with_depth and no_depth, f"no depth: {no_depth}")
        self.refuse("inputs", "rgb" not in self.inputs, "rgb, and perhaps others")
        self.label_map = None if distances else self.find_label_map()
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
        self.refuse("classes", name not in self.label_maps, " or ".join(self.label_maps))
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
    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`; depth files are among them if the data set `reads_depth`."""

    def decode(self, files: ImageFiles) -> Image:
        """Decode the files of an image, at any size; z-depth of photos."""
        labels: Any = None if self.has_distances else self.decode_labels(files)
        depth = None if files.depth is None else self.decode_depth(files)
        return Image(read_rgb(files.rgb), depth, labels, camera_matrix=self.decode_camera(files))

    def decode_labels(self, files: ImageFiles) -> Labels:
        """Return the labels of an image."""
        label_map: Any = self.label_map
        labels: NDArray[np.uint8] = label_map.read_labels(files.labels)
        return labels

    def panoptic_map(self, labels: Labels, numbers: Labels) -> Labels:
        """Return labels with the numbers of objects; things without a number are unknown."""
        is_thing = np.isin(self.class_names, self.things)[labels]
        codes = labels * np.int32(LABEL) + numbers * is_thing
        return np.where(is_thing & (numbers == 0), 0, codes)

    def decode_depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Return depth in steps of 1/512 m, 0 where missing; see `read_depth_m`."""
        path: Any = files.depth
        return meters_to_steps(read_depth_m(path, self.units_per_m))

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64] | None:
        """Return ``(3, 3)`` K of a photo for integer pixel centers; None for a panorama."""
        return None

    def pose(self, files: ImageFiles) -> PanoramaPose | None:
        """Return the pose of an image, before any rotation; None if unknown.

        In a photo's axes, x is the optical axis, y points to the right and z up in the image.
        """
        return None

    # --- reading -------------------------------------------------------------------------------

    def read(self, files: ImageFiles) -> Image:
        """See `DataModule`: the image at its size in training, with its labels or distances.

        RGB, depth and labels are resized on one pixel grid: the outer edges of source and target
        agree, so target row i covers source rows ``i · H / h`` to ``(i + 1) · H / h``. RGB is
        averaged over that area; labels and depth are taken from the source pixel at its center.
        """
        rgb, depth, labels, *_, matrix = self.decode(files)
        if depth is not None and matrix is not None:
            depth = distance_from_z_depth(depth, matrix)
        near, shape = rgb, self.read_shape
        if shape is not None:
            near = rgb if self.unknown == "labels" else resize(rgb, shape, "nearest")
            rgb = resize(rgb, shape, "bilinear")
            depth = None if depth is None else resize_depth(depth, shape)
            labels = labels if labels is None else resize(labels, shape, "nearest")
        if self.has_distances and depth is not None:
            # From 128 m, 16 bits do not hold the distance.
            labels, depth = np.where(depth < MOST_STEPS, depth, np.uint16(0)), None
        return Image(rgb, depth, mask_black(labels, near, self.unknown), camera_matrix=matrix)

    def read_labels(self, files: ImageFiles) -> Labels:
        """Return only the labels of `read`."""
        if self.has_distances or self.unknown != "labels":
            return self.read(files).labels
        labels, shape = self.decode_labels(files), self.read_shape
        return labels if shape is None else resize(labels, shape, "nearest")

    def check_files(self, files: ImageFiles) -> None:
        """See `DataModule`: the files of an image are complete, suit the settings, of one size."""
        size = read_image_size(files.rgb)
        self.check_size(files, size)
        for path in (files.labels, files.depth):
            if path is not None and path.suffix != ".json":
                found = read_image_size(path)
                if found != size:
                    expected = f"{width_height(size)}, as {files.rgb}"
                    raise DataError(path, found=width_height(found), expected=expected)

    @abstractmethod
    def check_size(self, files: ImageFiles, size: tuple[int, int]) -> None:
        """Refuse an image whose rows and columns do not suit the settings."""

    def inspect(self, files: ImageFiles, item: Image) -> tuple[NDArray[np.int64], str]:
        """See `DataModule`; of distances that are probably in other units is warned."""
        labels: Any = item.labels
        warning = ""
        if self.has_distances:
            known = labels[labels > 0]
            median_m = np.median(known) / STEPS_PER_M if known.size else 0
            if not _USUAL_M[0] <= median_m <= _USUAL_M[1]:
                found = (
                    f"median distance {median_m:.3g} m" if known.size else "no distance below 128 m"
                )
                warning = f"{files.depth}: {found}; check the units and the missing value."
        labels = self.counted_labels(labels).ravel()
        return np.bincount(labels, minlength=len(self.label_names)), warning

    def counted_labels(self, labels: Any) -> Any:
        """Return the index in `label_names` of each pixel of labels, an array or a tensor."""
        if self.has_distances:
            return labels > 0
        return labels // LABEL if self.labels == PANOPTIC else labels

    # --- samples -------------------------------------------------------------------------------

    @property
    def in_channels(self) -> int:
        """Total channels of all inputs."""
        return len(channel_names(self.inputs))

    def normalized(self, batch: Any) -> Tensor:
        """See `DataModule`."""
        return normalize(batch.images, self.normalization, self.inputs)


@data_set
class PhotoDataModule(ImageDataModule):
    """Labeled photos of one data set, see `ImageDataModule`.

    The representation is the camera to which all photos are normalized. A subclass defines
    `decode_camera`.

    Args:
        batch_size: Photos per training step and process. Evaluation takes one at a time.
    """

    noun: ClassVar[str] = "photos"
    suitable = ("of_camera", "perspective")
    default_representation = staticmethod(PerspectiveRepresentation)  # crops of 45°
    fact_settings: ClassVar[tuple[str, ...]] = ("size",)

    batch_size: PositiveInt = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        unknown = "no elevation: the horizon of a photo is unknown"
        self.refuse("inputs", "elevation" in self.inputs, unknown)

    @property
    def size(self) -> str:
        """Size of the crops that are scored, which cover all pixels of a photo."""
        height, width = self.representation.image_size
        return f"crops of {self.representation.fov_deg:g}° in {width} × {height}"

    def check_size(self, files: ImageFiles, size: tuple[int, int]) -> None:
        """See `ImageDataModule`: the crops fit into the photo."""
        camera: Any = self.decode_camera(files)
        shift_range(camera, size, self.representation.fov_deg, self.representation.image_size)


@data_set
class PanoramaDataModule(ImageDataModule):
    """Labeled panoramas of one data set, see `ImageDataModule`.

    Args:
        batch_size: Panoramas per training step and process. Evaluation takes one at a time.
        area: The part of the sphere that all files show: west, east, south and north in degrees,
            see `check_area`; None for the whole sphere.
        fill: Colors of the panorama outside the area, in views that leave it.
        mask: Pixels that are ignored in training and evaluation, before the panorama is rotated:
            their labels are unknown. See `Masks`.
        test_rotation: Rotate the test panoramas, as seen by a tilted camera: a tilt in degrees
            about a random horizontal axis, after a random rotation about the vertical; or `so3`,
            uniform over all rotations. Labels rotate with the image.
        upright: Align tilted panoramas with gravity. `pose`: as their files say (GPano) and, of
            test panoramas, as they were rotated. `auto`: as their files say, else as estimated from
            the image.
        max_tilt_deg: Largest tilt that `auto` considers, a few degrees above that of the data.

    Attributes:
        erp_height: Rows of the panoramas read.
        canvas: The area, in pixels of these panoramas.

    Raises:
        DataError: The mask cannot be used.
    """

    noun: ClassVar[str] = "panoramas"
    fact_settings: ClassVar[tuple[str, ...]] = ("size", "area", "mask", "test_rotation")

    area: Sequence[float] | None = None
    fill: Fill = "mean"
    mask: Any = None
    test_rotation: TestRotation = None
    upright: Upright = None
    max_tilt_deg: Annotated[float, Field(gt=0, le=180)] = 60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.erp_height: int = self.representation.erp_height
        self.canvas = PanoramaArea.on_canvas(self.area, self.erp_height, "data.area")
        self.representation.view_sets(self.canvas.valid)  # refuses views that miss a pixel
        self._judge: PanoramaJudge | None = None
        self._ups: dict[tuple[Split, int], NDArray[np.float64] | None] = {}
        self._masks = Masks(self.mask, "data.mask")
        if not self._masks.of_each:
            self._masks.read("", self.canvas)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_judge": None}  # a network

    @property
    def size(self) -> str:
        """Width and height of the panoramas whose pixels are scored."""
        return f"{2 * self.erp_height} × {self.erp_height}"

    @property
    def read_shape(self) -> tuple[int, int]:
        """Rows and columns of the area in panoramas of `erp_height` rows."""
        return self.canvas.image_shape

    def check_size(self, files: ImageFiles, size: tuple[int, int]) -> None:
        """See `ImageDataModule`: enough pixels, in the shape of the area, and a mask."""
        check_resolution(files.rgb, size, self.canvas, self.area)
        if self._masks.of_each:
            self._masks.check(files.name, self.canvas)

    def finish(self, item: Image, split: Split, index: int) -> Image:
        """See `DataModule`: placed on the sphere, masked, rotated, then aligned with gravity."""
        files: ImageFiles = self.splits()[split][index]
        image, canvas, rotation = item, self.canvas, None
        if not canvas.is_whole:
            colors = canvas.filled(canvas.place(image.rgb), self.fill)
            image = _changed(image, colors, canvas.place)._replace(valid=canvas.valid)
        if self.mask is not None:
            counts, labels = self._masks.read(files.name, canvas), image.labels
            image = image._replace(labels=np.where(counts, labels, labels.dtype.type(0)))
        up = None if self.upright is None else read_up(files.rgb)
        if split == "test" and self.test_rotation is not None:
            rotation = draw_rotation(self.test_rotation, self.seed, index)
            colors = rotate_equirect(image.rgb, rotation, "bilinear")
            image = _changed(image, colors, partial(_rotated, rotation=rotation))
            up = None if self.upright != "pose" else rotation @ ([0, 0, 1] if up is None else up)
        if self.upright == "auto" and up is None:
            if (split, index) not in self._ups:
                self._ups[split, index] = self._estimated_up(image, files, rotation, split)
            up = self._ups[split, index]
        return image._replace(up=up)

    def _estimated_up(
        self, image: Image, files: ImageFiles, rotation: NDArray[np.float64] | None, split: Split
    ) -> NDArray[np.float64] | None:
        """Estimate the up direction; small panoramas are read again at the size of the file."""
        rgb = black_outside(image.rgb, image.valid)  # estimates ignore what is black
        judge = self._judge if split == "test" else None
        evidence = judge and partial(judge, image._replace(rgb=rgb))
        if len(rgb) < MOST_ROWS:
            rgb = read_rgb(files.rgb)
            size = rgb.shape[0], rgb.shape[1]
            whole = read_area(files.rgb, size, check_area(self.area)).full_shape
            canvas = PanoramaArea.on_canvas(self.area, min(whole[0], MOST_ROWS))
            rgb = canvas.place(resize(rgb, canvas.image_shape, "bilinear"))
            rgb = rgb if rotation is None else rotate_equirect(rgb, rotation, "bilinear")
        return estimate_up(rgb, self.max_tilt_deg, evidence)

    def estimate_up(self, judge: PanoramaJudge) -> None:
        """Let a network help to estimate the up directions of the test panoramas.

        They are estimated when the loader of the test split is created, because the network is on
        its device by then. Without ``upright=auto`` nothing changes.

        Args:
            judge: Returns log-likelihoods of up directions, see `gravity.estimate_up`.
        """
        if self.upright == "auto":
            self._judge = judge
            self._ups = {key: up for key, up in self._ups.items() if key[0] != "test"}
            self._datasets.pop("test", None)

    def test_dataloader(self) -> DataLoader[Any]:
        """Return the test batches; a network first estimates the up directions, in this process."""
        dataset = self.dataset("test")
        if self._judge is not None:
            read = map(dataset.read, range(len(dataset)))
            show_progress(read, "Estimating up", self.noun, len(dataset))
        return super().test_dataloader()


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


def _changed(
    image: Image, rgb: NDArray[np.uint8], change: Callable[[NDArray[Any]], NDArray[Any]]
) -> Image:
    """Return a panorama of other colors, with its other pixels changed."""
    others = {name: getattr(image, name) for name in ("depth", "labels", "valid")}
    changed = {name: change(array) for name, array in others.items() if array is not None}
    return image._replace(rgb=rgb, **changed)


def _rotated(pixels: NDArray[Any], rotation: NDArray[np.float64]) -> NDArray[Any]:
    if pixels.dtype == np.bool_:
        return rotate_equirect(pixels.view(np.uint8), rotation, "nearest") > 0
    return rotate_equirect(pixels, rotation, "nearest")
