"""Base data modules of labeled images: panoramas and photos."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from torch import Tensor
from torch.utils.data import DataLoader

from datamodules.core.index import DatasetIndex, Split
from datamodules.core.inputs import (
    RGB_NORMALIZATION,
    RGBD_NORMALIZATION,
    Input,
    Normalization,
    channel_names,
    normalize,
    ordered_inputs,
)
from datamodules.core.labeled_images import LabeledImages
from datamodules.core.labels import DISTANCE, PIXEL_CLASSES, ClassSet
from datamodules.core.panoramas import (
    ImageFiles,
    ImageReader,
    Labels,
    Panorama,
    PanoramaDistances,
    PanoramaReading,
    PhotoDistances,
    PhotoReading,
    TestRotation,
    Unknown,
    check_headers,
)
from datamodules.core.problems import Problems
from datamodules.core.reading import Transform
from datamodules.core.samples import EvaluationImages, TrainingImages
from datamodules.core.split_module import SplitDataModule
from datamodules.core.store import Store
from datamodules.core.transforms import (
    EstimatedUp,
    PanoramaJudge,
    PosedUp,
    RotatedPanoramas,
    masked,
    placed,
)
from tangent_train.errors import SettingError
from tangent_train.geometry import shift_range
from tangent_train.geometry.equirect import check_area
from tangent_train.io.gpano import Fill, PanoramaArea, check_area_size
from tangent_train.io.masks import Mask, Masks
from tangent_train.io.png import check_panorama_size
from tangent_train.progress import show_progress
from tangent_train.rendering import PerspectiveRepresentation, TangentRepresentation
from tangent_train.threads import in_threads

_DISTANCES = "Data sets with depth are listed in docs/how-to/train_depth.md."


@dataclass(kw_only=True, eq=False, repr=False)
class ImageDataModule(SplitDataModule[ImageFiles]):
    """Labeled panoramas or photos of one data set.

    A subclass defines the images (`find_images`) and the `class_names`; the first name is that of
    unknown pixels (label 0).

    Args:
        labels: `pixel_classes`, or `distance`: depth files give the labels, and there are no
            classes, see `DISTANCE`.
        inputs: Inputs of the network, `rgb` and optionally others, see `Input`.
        color_jitter: Strength of the color augmentation, 0 (none) to 1, see `jitter_colors`.
        classes: Name of a set of classes of the data set; None for the first.
        unknown: Black pixels that are unknown too, see `mask_black`.

    Attributes:
        normalizations: Default normalizations, without and with depth.
        class_sets: Sets of classes by name, see `class_sets`; empty if there is only one.
        no_depth: Reason why depth cannot be an input; empty if it can.
        no_distances: Reason why distances cannot be the labels, besides `no_depth`.

    Raises:
        SettingError: A setting is invalid.
    """

    normalizations: ClassVar[tuple[Normalization, Normalization]] = (
        RGB_NORMALIZATION,
        RGBD_NORMALIZATION,
    )

    class_sets: ClassVar[Mapping[str, ClassSet]] = {}
    no_depth: ClassVar[str] = ""
    no_distances: ClassVar[str] = ""
    fact_settings: ClassVar[tuple[str, ...]] = ("unknown",)

    labels: str = PIXEL_CLASSES
    inputs: Sequence[Input] = ("rgb", "depth")
    color_jitter: float = 0.0
    classes: str | int | None = None
    unknown: Unknown = "labels"

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_one_of("labels", PIXEL_CLASSES, DISTANCE)
        if self.has_distances:
            self.class_names = ()
            reason = self.no_depth or self.no_distances
            self.require("labels", not reason, f"{PIXEL_CLASSES}: {reason}", _DISTANCES)
        class_sets = {} if self.has_distances else self.class_sets
        chosen = next(iter(class_sets), None) if self.classes is None else str(self.classes)
        fine = chosen is None or chosen in class_sets
        self.require("classes", fine, " or ".join(class_sets) or "null: no other classes")
        self.class_set = None if chosen is None else class_sets[chosen]
        if self.class_set is not None:
            self.class_names = ("unknown", *self.class_set.names)
        self.require_one_of("unknown", "labels", "any_black", "all_black")
        self.inputs = ordered_inputs(self.inputs)
        with_depth = "depth" in self.inputs
        self.require("inputs", not (with_depth and self.no_depth), f"no depth: {self.no_depth}")
        fine = not (with_depth and self.has_distances)
        self.require("inputs", fine, "no depth: it is the target", "Give data.inputs=[rgb].")
        given = self.normalization or self.normalizations[with_depth]
        self.normalization = Normalization.of(given, 3 + with_depth, "data.normalization")
        self.require("color_jitter", 0 <= self.color_jitter <= 1, "0 to 1")

    @property
    def has_distances(self) -> bool:
        """True if the labels are distances."""
        return self.labels == DISTANCE

    @property
    def reads_depth(self) -> bool:
        """True if depth files are read, as input or labels."""
        return self.has_distances or "depth" in self.inputs

    @abstractmethod
    def find_images(
        self, problems: Problems
    ) -> tuple[ImageReader, Mapping[Split, Sequence[ImageFiles]]]:
        """Return the reader of the data set and the files of each split, not yet opened.

        Depth files are among them if the data set `reads_depth`.

        Args:
            problems: Collects problems of the folders.

        Raises:
            DataError: The data set as a whole cannot be used.
        """

    @abstractmethod
    def reading(self, reader: ImageReader) -> PanoramaReading | PhotoReading:
        """Return a function that reads one image as it is stored."""

    @abstractmethod
    def check_image(self, files: ImageFiles, reader: ImageReader, problems: Problems) -> None:
        """Check, without decoding, that the files are complete and fit the settings."""

    def find(self, problems: Problems) -> DatasetIndex[ImageFiles]:
        """See `LabeledData`."""
        reader, splits = self.find_images(problems)
        if self.has_distances:
            splits = {s: [f._replace(labels=None) for f in splits[s]] for s in splits}
            fine = all(f.depth for files in splits.values() for f in problems.without(files))
            self.require("labels", fine, f"{PIXEL_CLASSES}: `find_images` lists no depth files")
        read = self.reading(reader)
        store = Store.of(self.store, read.store_name, read.settings, read.layout)
        index = DatasetIndex(self.noun, splits, read, read.kind, store)
        check = partial(self.check_image, reader=reader, problems=problems)
        for _ in in_threads(check, index.of()):
            pass
        return index

    def dataset(self, split: Split) -> TrainingImages | EvaluationImages:
        """See `LabeledData`: samples `TrainingSample` or `EvaluationSample`."""
        source, inputs = self.source(split), self.inputs
        if split != "train":
            return EvaluationImages(source, self.representation, inputs)
        seed = self.seed, self.sampling_seed
        return TrainingImages(source, self.representation, seed, inputs, self.color_jitter)

    def images(self, split: Split) -> LabeledImages:
        """Return the whole images of a split as arrays, see `LabeledImage`."""
        reading: Any = self.index().read
        return LabeledImages(self.source(split), reading.reader)

    @property
    def in_channels(self) -> int:
        """Total channels of all inputs."""
        return len(channel_names(self.inputs))

    def normalized(self, batch: Any) -> Tensor:
        """See `LabeledData`."""
        normalization: Any = self.normalization
        return normalize(batch.images, normalization, self.inputs)


_HALF_TURN_DEG = 180
_PARTIAL = "If all images show the same part, give data.area=[west,east,south,north] in degrees."

Upright = Literal["pose", "auto"] | None
"""Source of the up direction of a panorama."""


@dataclass(kw_only=True, eq=False, repr=False)
class PanoramaDataModule(ImageDataModule):
    """Labeled panoramas of one data set, see `ImageDataModule`.

    Args:
        batch_size: Panoramas per training step and process. Evaluation takes one at a time.
        area: The part of the sphere that all files show: west, east, south and north in degrees,
            see `check_area`; None for the whole sphere.
        fill: Colors of the panorama outside the area, in views that leave it.
        mask: Pixels that are ignored in training and evaluation, before the panorama is rotated:
            their labels are unknown. See `Masks`.
        test_rotation: Rotate the test panoramas: tilt in degrees, or `so3`, see `RotatedPanoramas`.
        upright: Align tilted panoramas with gravity. `pose`: as their files say (GPano) and, of
            test panoramas, as they were rotated. `auto`: as their files say, else as estimated from
            the image.
        max_tilt_deg: Largest tilt that `auto` considers, a few degrees above that of the data.

    Attributes:
        erp_height: Rows of the panoramas read.
        canvas: The area, in pixels of these panoramas.

    Raises:
        DataError: The mask cannot be used.
        SettingError: A setting is invalid.
    """

    noun: ClassVar[str] = "panoramas"
    fact_settings: ClassVar[tuple[str, ...]] = ("size", "area", "mask", "test_rotation")

    batch_size: int = 4
    area: Sequence[float] | None = None
    fill: Fill = "mean"
    mask: Mask = None
    test_rotation: TestRotation = None
    upright: Upright = None
    max_tilt_deg: float = 60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_representation("erp_height", "tangent")
        self.erp_height: int = self.representation.erp_height
        self._judge: PanoramaJudge | None = None
        rotation = self.test_rotation
        tilt = type(rotation) in (int, float) and 0 <= float(rotation or 0) <= _HALF_TURN_DEG
        fine = tilt or rotation in (None, "so3")
        self.require("test_rotation", fine, "null, a tilt of 0 to 180 degrees, or so3")
        self.require("upright", self.upright in (None, "pose", "auto"), "null, pose or auto")
        fine = 0 < self.max_tilt_deg <= _HALF_TURN_DEG
        self.require("max_tilt_deg", fine, "more than 0, at most 180")
        self.require("fill", self.fill in get_args(Fill), ", ".join(get_args(Fill)))
        self.canvas = PanoramaArea.on_canvas(self.area, self.erp_height, "data.area")
        self.representation.view_sets(self.canvas.valid)  # refuses views that miss a pixel
        self._masks = Masks(self.mask, "data.mask")
        if not self._masks.of_each:
            self._masks.read("", self.canvas)

    @property
    def size(self) -> str:
        """Width and height of the panoramas whose pixels are scored."""
        return f"{2 * self.erp_height} × {self.erp_height}"

    def default_representation(self) -> TangentRepresentation:
        """Tangent images of base level 0, at level 7."""
        return TangentRepresentation(0, 7 if self.level is None else self.level)

    def reading(self, reader: ImageReader) -> PanoramaReading:
        """See `ImageDataModule`."""
        shape, count = self.canvas.image_shape, len(self.class_names)
        kind = PanoramaDistances if self.has_distances else PanoramaReading
        return kind(reader, count, shape, self.class_set, self.unknown)

    def check_image(self, files: ImageFiles, reader: ImageReader, problems: Problems) -> None:
        """See `ImageDataModule`; also checks that the panorama has a mask."""
        check_headers(files, reader, problems, self._check_size)
        if self._masks.of_each:
            with problems.noted(files.name):
                self._masks.check(files.name, self.canvas)

    def _check_size(self, path: Path, size: tuple[int, int]) -> None:
        if self.canvas.is_whole:
            check_panorama_size(path, size, self.erp_height, _PARTIAL)
        else:
            check_area_size(path, size, check_area(self.area), self.canvas)

    def transforms(self, split: Split) -> Sequence[Transform[Panorama, Any]]:
        """See `LabeledData`: placing, mask, rotation, then alignment with gravity."""
        transforms: list[Transform[Panorama, Any]] = []
        rotated = None
        if not self.canvas.is_whole:
            transforms.append(partial(placed, self.canvas, self.fill))
        if self.mask is not None:
            transforms.append(partial(masked, self._masks, self.canvas))
        if self.upright is not None:
            transforms.append(PosedUp())
        if split == "test" and self.test_rotation is not None:
            known = self.upright == "pose"
            rotated = RotatedPanoramas(self.test_rotation, self.seed, known=known)
            transforms.append(rotated)
        if self.upright == "auto":
            judge = self._judge if split == "test" else None
            reading: Any = self.index().read
            read = reading.reader.rgb
            transforms.append(EstimatedUp(self.max_tilt_deg, read, rotated, judge, self.area))
        return transforms

    def recorded(self, labels: Labels) -> Labels:
        """See `LabeledData`: those in the area."""
        return self.canvas.cut(labels)

    def panoramas(self, split: Split) -> LabeledImages:
        """Return the whole panoramas of a split as arrays, masked and rotated as set."""
        return self.images(split)

    def estimate_up(self, judge: PanoramaJudge) -> None:
        """Let a network help to estimate the up directions of the test panoramas.

        They are estimated when the loader of the test split is created, because the network is on
        its device by then. Without ``upright=auto`` nothing changes.

        Args:
            judge: Returns log-likelihoods of up directions, see `gravity.estimate_up`.
        """
        if self.upright == "auto":
            self._judge = judge
            self._readers.pop("test", None)

    def test_dataloader(self) -> DataLoader[Any]:
        """Return the test batches; a network first estimates the up directions, in this process."""
        source = self.source("test")
        if self._judge is not None:
            read = (source.read(index) for index in range(len(source)))
            show_progress(read, "Estimating up", self.noun, len(source))
        return super().test_dataloader()


@dataclass(kw_only=True, eq=False, repr=False)
class PhotoDataModule(ImageDataModule):
    """Labeled photos of one data set, see `ImageDataModule`.

    The representation is the camera to which all photos are normalized.

    Args:
        batch_size: Photos per training step and process. Evaluation takes one at a time.

    Raises:
        SettingError: A setting is invalid.
    """

    noun: ClassVar[str] = "photos"
    fact_settings: ClassVar[tuple[str, ...]] = ("size",)

    batch_size: int = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_representation("of_camera", "perspective")
        self.require(
            "inputs",
            "elevation" not in self.inputs,
            "no elevation: the horizon of a photo is unknown",
            "Train on photos without it, then on panoramas with it and init_from=…: "
            "its filters start at zero.",
        )

    @property
    def size(self) -> str:
        """Size of the crops that are scored, which cover all pixels of a photo."""
        representation: Any = self.representation
        height, width = representation.image_size
        return f"crops of {representation.fov_deg:g}° in {width} × {height}"

    def default_representation(self) -> PerspectiveRepresentation:
        """Crops of 45° at the resolution of level 7."""
        return PerspectiveRepresentation(7 if self.level is None else self.level)

    def reading(self, reader: ImageReader) -> PhotoReading:
        """See `ImageDataModule`."""
        kind = PhotoDistances if self.has_distances else PhotoReading
        return kind(reader, len(self.class_names), None, self.class_set, self.unknown)

    def photos(self, split: Split) -> LabeledImages:
        """Return the whole photos of a split as arrays."""
        return self.images(split)

    def check_image(self, files: ImageFiles, reader: ImageReader, problems: Problems) -> None:
        """See `ImageDataModule`; also checks that the crops fit into the photo."""
        size = check_headers(files, reader, problems)
        if size is None:
            return
        representation: Any = self.representation
        with problems.noted(files.name, files.rgb):
            camera_matrix = reader.camera(files)
            try:
                shift_range(camera_matrix, size, representation.fov_deg, representation.image_size)
            except SettingError as error:
                columns = representation.image_size[1]
                extent = camera_matrix[1, 1] * math.tan(math.radians(representation.fov_deg) / 2)
                rows = int(size[0] / 2 / extent * columns)
                # A setting: if it fits none of the photos, it is refused once.
                raise SettingError(
                    "representation.fov_deg",
                    found=f"{error.found}, {files.rgb}",
                    expected=f"all of a crop of {representation.fov_deg:g}°",
                    remedy="Lower it, make the crops less high with "
                    f"representation.dim=[{rows},{columns}] or fewer rows, or remove the photo.",
                ) from error
