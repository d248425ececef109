"""Base data module of labelled images: panoramas and photos."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from datamodules.core.found import Split
from datamodules.core.inputs import RGB_NORMALIZATION, RGBD_NORMALIZATION, Input, Normalization
from datamodules.core.problems import Problems
from datamodules.core.reading import ImageFiles, ImageReader
from datamodules.core.samples import ImageSamples
from datamodules.core.split_module import SplitDataModule

__all__ = ["ImageDataModule"]


@dataclass(kw_only=True, eq=False, repr=False)
class ImageDataModule(SplitDataModule[ImageFiles]):
    """Labelled panoramas or photos of one data set.

    A data set says which images it has (`find_images`) and its `class_names`, the unknown one (0)
    first.

    Args:
        inputs: Inputs of the network, `rgb` and optionally others, see `Input`.
        color_jitter: Strength of the colour augmentation, 0 (none) to 1, see `jitter_colors`.

    Attributes:
        normalizations: The default ones, without and with depth.

    Raises:
        SettingError: A setting is invalid.
    """

    normalizations: ClassVar[tuple[Normalization, Normalization]] = (
        RGB_NORMALIZATION,
        RGBD_NORMALIZATION,
    )

    inputs: Sequence[Input] = ("rgb", "depth")
    color_jitter: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        default = self.normalizations["depth" in self.inputs]
        self.samples = ImageSamples(self.inputs, self.normalization or default, self.color_jitter)
        self.inputs, self.normalization = self.samples.inputs, self.samples.normalization

    @abstractmethod
    def find_images(
        self, problems: Problems
    ) -> tuple[ImageReader, Mapping[Split, Sequence[ImageFiles]]]:
        """Return the reader of the data set and the files of all splits, not yet opened.

        Args:
            problems: Problems of the folders are added.

        Raises:
            DataError: The data set as a whole cannot be used.
        """
