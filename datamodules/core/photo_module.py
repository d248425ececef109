"""Base data module of photo data sets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

from datamodules.core.found import Found, Split
from datamodules.core.image_module import ImageDataModule
from datamodules.core.photos import Photo
from datamodules.core.pipeline import SplitItems
from datamodules.core.problems import Problems
from datamodules.core.reading import ImageFiles, ImageReader, PhotoReading, check_headers
from datamodules.core.store import Store
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import shift_range
from tangent_train.threads import in_threads

__all__ = ["PhotoDataModule", "Split"]


@dataclass(kw_only=True, eq=False, repr=False)
class PhotoDataModule(ImageDataModule):
    """Labelled photos of one data set, see `ImageDataModule`.

    The representation is the camera to which all photos are normalized.

    Args:
        photos_per_step: Photos per training step and process. Evaluation takes one at a time.

    Raises:
        SettingError: A setting is invalid.
    """

    noun: ClassVar[str] = "photos"

    photos_per_step: int = 16

    def __post_init__(self) -> None:
        super().__post_init__()
        self.need_representation(
            "of_camera",
            "one for photos",
            "Choose representation=perspective, or panoramas, as data=synthrooms.",
        )
        if "elevation" in self.inputs:
            raise SettingError(
                "data.inputs",
                found=list(self.inputs),
                expected="no elevation: the horizon of a photo is unknown",
                remedy="Train on photos without it, then on panoramas with it and init_from=…: "
                "its filters start at zero.",
            )

    def find(self, problems: Problems) -> Found[ImageFiles]:
        """See `SplitDataModule`."""
        reader, splits = self.find_images(problems)
        store = Store.of(self.store, "photos", reader.settings)
        found = Found(self.noun, splits, PhotoReading(reader, len(self.class_names)), store)
        check = partial(self._check, reader=reader, problems=problems)
        for _ in in_threads(check, found.of()):
            pass
        return found

    def pipeline(self, found: Found[ImageFiles], split: Split) -> SplitItems[ImageFiles, Photo]:
        """Photos from files or store."""
        return SplitItems(found.splits[split], found.read, Photo, found.store)

    def _check(self, files: ImageFiles, reader: ImageReader, problems: Problems) -> None:
        """Make sure that the files are whole and that crops fit into the photo."""
        size = check_headers(files, reader, problems)
        if size is None:
            return
        representation: Any = self.representation
        with problems.noted(files.name, files.rgb):
            camera_matrix = reader.camera(files)
            try:
                shift_range(camera_matrix, size, representation.fov_deg, representation.image_size)
            except SettingError as error:
                raise DataError(
                    files.rgb,
                    found=error.found,
                    expected=f"all of a crop of {representation.fov_deg:g}°",
                    remedy="Lower representation.fov_deg, or leave the photo out.",
                ) from error
