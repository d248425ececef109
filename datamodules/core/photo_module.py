"""What the data modules of all data sets of photos share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from datamodules.core.photos import Photo
from datamodules.core.segmentation_module import SegmentationDataModule, Split
from tangent_train.errors import DataError, SettingError
from tangent_train.geometry import shift_range

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from tangent_train.rendering.representations.perspective import PerspectiveRepresentation

__all__ = ["PhotoDataModule", "Split"]


class PhotoDataModule(SegmentationDataModule[Photo]):
    """Photos of one data set.

    A data set says which photos it has (`find_splits`) and its `class_names`.

    Args:
        representation: The camera that all photos are brought to.
        photos_per_step: Photos per training step and process.
        **settings: All others of `SegmentationDataModule`.

    Raises:
        SettingError: A setting that cannot work.
    """

    noun: ClassVar[str] = "photos"

    def __init__(
        self,
        representation: PerspectiveRepresentation,
        *,
        photos_per_step: int = 16,
        **settings: Any,
    ) -> None:
        if not hasattr(representation, "of_camera"):
            raise SettingError(
                "representation",
                found=type(representation).__name__,
                expected="one for photos",
                remedy="Choose representation=perspective, or panoramas, as data=synthrooms.",
            )
        super().__init__(representation, photos_per_step, **settings)
        if "elevation" in self.inputs:
            raise SettingError(
                "data.inputs",
                found=list(self.inputs),
                expected="no elevation: nobody knows where the horizon of a photo is",
                remedy="Train on photos without it, then on panoramas with it and init_from=…: "
                "its filters start at zero.",
            )

    def check_camera(
        self, path: Path, camera_matrix: NDArray[np.float64], size: tuple[int, int]
    ) -> None:
        """Make sure that crops fit into a photo.

        Args:
            path: The photo.
            camera_matrix: ``(3, 3)`` K.
            size: ``(height, width)``.

        Raises:
            DataError: It sees less than a crop has to.
        """
        fov_deg, crop = self.representation.fov_deg, self.representation.image_size
        try:
            shift_range(camera_matrix, size, fov_deg, crop)
        except SettingError as error:
            raise DataError(
                path,
                found=error.found,
                expected=f"all of a crop of {fov_deg:g}°",
                remedy="Lower representation.fov_deg, or leave the photo out.",
            ) from error
