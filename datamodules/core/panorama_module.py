"""Base data module of panorama data sets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

from torch.utils.data import DataLoader

from datamodules.core.found import Found, Split
from datamodules.core.image_module import ImageDataModule
from datamodules.core.panoramas import Panorama, Turn
from datamodules.core.pipeline import (
    EstimatedUp,
    MaskedPanoramas,
    PanoramaJudge,
    PosedUp,
    RotatedPanoramas,
    SplitItems,
    Transform,
)
from datamodules.core.problems import Problems
from datamodules.core.progress import show_progress
from datamodules.core.reading import ImageFiles, ImageReader, PanoramaReading, check_headers
from datamodules.core.store import Store
from datamodules.images.gpano import whole_area
from datamodules.images.masks import Mask, Masks
from tangent_train.errors import SettingError
from tangent_train.threads import in_threads

__all__ = ["PanoramaDataModule", "Split", "Upright"]

_HALF_TURN_DEG = 180

Upright = Literal["pose", "auto"] | None
"""Source of the up direction of a panorama."""


@dataclass(kw_only=True, eq=False, repr=False)
class PanoramaDataModule(ImageDataModule):
    """Labelled panoramas of one data set, see `ImageDataModule`.

    Args:
        panoramas_per_step: Panoramas per training step and process. Evaluation takes one at a time.
        mask: What does not count in training and evaluation, in the panorama's own frame, before
            it is rotated: labels are unknown there, pixels stay. See `Masks`.
        test_rotation: Rotate the test panoramas: tilt in degrees, or `so3`, see `RotatedPanoramas`.
        upright: Align tilted panoramas with gravity. `pose`: as their files say (GPano) and, of
            test panoramas, as they were rotated. `auto`: as their files say, else as estimated from
            the image, see `judge`.
        max_tilt_deg: Of `auto`: some degrees more than they are tilted, see `estimate_up`.

    Attributes:
        erp_height: Rows of the panoramas read.
        judge: Of `auto`, for the test split: helps to estimate, see `estimate_up`. To be set before
            that split is read.

    Raises:
        DataError: The mask cannot be used.
        SettingError: A setting is invalid.
    """

    noun: ClassVar[str] = "panoramas"

    panoramas_per_step: int = 4
    mask: Mask = None
    test_rotation: Turn = None
    upright: Upright = None
    max_tilt_deg: float = 60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need_representation(
            "erp_height",
            "one for panoramas",
            "Choose representation=tangent, or photos, as data=synthrooms_perspective.",
        )
        self.erp_height: int = self.representation.erp_height
        self.judge: PanoramaJudge | None = None
        self._check_rotations()
        self._masks = Masks(self.mask, "data.mask")
        if not self._masks.of_each:
            self._masks.read("", whole_area(Path(), (self.erp_height, 2 * self.erp_height)))

    def find(self, problems: Problems) -> Found[ImageFiles]:
        """See `SplitDataModule`."""
        reader, splits = self.find_images(problems)
        height, width = shape = self.erp_height, 2 * self.erp_height
        read = PanoramaReading(reader, len(self.class_names), shape)
        store = Store.of(self.store, f"{height}x{width}", reader.settings)
        found = Found(self.noun, splits, read, store)
        check = partial(self._check, reader=reader, problems=problems)
        for _ in in_threads(check, found.of()):
            pass
        return found

    def _check(self, files: ImageFiles, reader: ImageReader, problems: Problems) -> None:
        """Make sure that the files are whole, and that there is a mask."""
        check_headers(files, reader, problems, self.erp_height)
        if self._masks.of_each:
            with problems.noted(files.name):
                self._masks.check(files.name)

    def pipeline(self, found: Found[ImageFiles], split: Split) -> SplitItems[ImageFiles, Panorama]:
        """Panoramas from files or store: masked, rotated, then aligned with gravity."""
        transforms: list[Transform[Panorama, Any]] = []
        if self.mask is not None:
            transforms.append(MaskedPanoramas(self._masks))
        if self.upright is not None:
            transforms.append(PosedUp())
        if split == "test" and self.test_rotation is not None:
            known = self.upright == "pose"
            transforms.append(RotatedPanoramas(self.test_rotation, self.seed, known=known))
        if self.upright == "auto":
            judge = self.judge if split == "test" else None
            transforms.append(EstimatedUp(self.max_tilt_deg, judge))
        return SplitItems(found.splits[split], found.read, Panorama, found.store, transforms)

    def test_dataloader(self) -> DataLoader[Any]:
        """Batches for the test; what is to be judged is estimated first, in this process."""
        source = self.source("test")
        if self.judge is not None:
            read = (source.read(index) for index in range(len(source)))
            show_progress(read, "Estimating up", self.noun, len(source))
        return super().test_dataloader()

    def _check_rotations(self) -> None:
        rotation = self.test_rotation
        tilt = type(rotation) in (int, float) and 0 <= float(rotation or 0) <= _HALF_TURN_DEG
        if rotation not in (None, "so3") and not tilt:
            expected = "null, a tilt of 0 to 180 degrees, or so3"
            raise SettingError("data.test_rotation", found=repr(rotation), expected=expected)
        if self.upright not in (None, "pose", "auto"):
            raise SettingError("data.upright", found=self.upright, expected="null, pose or auto")
        if not 0 < self.max_tilt_deg <= _HALF_TURN_DEG:
            raise SettingError(
                "data.max_tilt_deg", found=self.max_tilt_deg, expected="more than 0, at most 180"
            )
