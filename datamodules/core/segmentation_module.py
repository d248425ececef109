"""What the data modules of all data sets of labelled images share: inputs, class weights."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np

from datamodules.core.class_weights import ClassWeights, class_weights
from datamodules.core.data_check import read_parts, unreadable
from datamodules.core.samples import (
    INPUTS,
    RGB_NORMALIZATION,
    RGBD_NORMALIZATION,
    EvaluationImages,
    Input,
    Normalization,
    TrainingImages,
    channel_names,
    collate,
    normalize,
)
from datamodules.core.sources import (
    ImageSource,
    LabelledImage,
    ReadableImages,
    RememberedImages,
    in_threads,
    read_strictly,
)
from datamodules.core.split_module import SPLITS, Kind, Split, SplitDataModule
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from torch import Tensor

__all__ = ["SPLITS", "SegmentationDataModule", "Split"]

_Image = TypeVar("_Image", bound=LabelledImage)


class SegmentationDataModule(SplitDataModule[ImageSource[_Image]], Generic[_Image]):
    """Labelled images of one data set, split for training, validation and test.

    A data set says which images it has (`find_splits`) and its `class_names`, the unknown one (0)
    first.

    Args:
        representation: What the network sees of an image.
        images_per_step: Images per training step and process. Evaluation takes one at a time.
        inputs: What the network is shown, `rgb` and perhaps others, see `Input`.
        color_jitter: Strength of the colour augmentation, 0 (none) to 1, see `jitter_colors`.
        normalization: Of RGB and depth; by default that of Stanford2D3DS.
        **settings: All others of `SplitDataModule`.

    Attributes:
        inputs: As given, in the order of the channels.
        in_channels: Of all inputs together.
        normalization: As given, or the default.

    Raises:
        SettingError: A setting that cannot work.
    """

    kind: ClassVar[Kind] = "segmentation"

    def __init__(
        self,
        representation: Any,
        images_per_step: int,
        *,
        inputs: Sequence[Input] = ("rgb", "depth"),
        color_jitter: float = 0.0,
        normalization: Normalization | None = None,
        **settings: Any,
    ) -> None:
        self.inputs = checked_inputs(inputs)
        default = RGBD_NORMALIZATION if self.with_depth else RGB_NORMALIZATION
        super().__init__(representation, images_per_step, normalization or default, **settings)
        if self.normalization.channels != default.channels:
            raise SettingError(
                "data.normalization",
                found=f"{self.normalization.channels} channels",
                expected=f"{default.channels}, for data.inputs={list(self.inputs)}",
            )
        self.in_channels = len(channel_names(self.inputs))
        if not isinstance(color_jitter, int | float) or not 0 <= color_jitter <= 1:
            raise SettingError("data.color_jitter", found=color_jitter, expected="0 to 1")
        self.color_jitter = color_jitter

    @property
    def with_depth(self) -> bool:
        """Whether depth is an input."""
        return "depth" in self.inputs

    @abstractmethod
    def find_splits(self) -> Mapping[Split, ImageSource[_Image]]:
        """The images of all splits as they are on disk, checked without decoding them.

        Raises:
            DataError: Something is missing or cannot be used.
            SettingError: The images are too small for the representation.
        """

    def content(self, splits: Mapping[Split, ImageSource[_Image]]) -> tuple[int, Iterator[None]]:
        """All files of all images, see `read_parts`."""
        return read_parts(splits, self.problems)

    def readable(
        self, splits: Mapping[Split, ImageSource[_Image]]
    ) -> Mapping[Split, ImageSource[_Image]]:
        """The same without the images that cannot be read."""
        broken = unreadable(splits, self.read_once, self.problems, self.noun)
        return {
            split: self.chosen(source, [i for i in range(len(source)) if (split, i) not in broken])
            for split, source in splits.items()
        }

    def read_once(self, source: ImageSource[_Image], index: int) -> None:
        """Make sure that an image of `find_splits` can be read.

        Raises:
            DataError: It is broken.
        """
        read_strictly(source, index)

    def chosen(self, source: ImageSource[_Image], indices: Sequence[int]) -> ImageSource[_Image]:
        """Some of the images of a source of `find_splits`."""
        return ReadableImages(source, indices)

    def sampled_splits(self) -> Sequence[Split]:
        """Those that are not read into memory as training begins."""
        return ("test",) if self.in_memory else SPLITS

    def remembered(self, source: ImageSource[_Image]) -> ImageSource[_Image]:
        """Decoded images, see `RememberedImages`."""
        return RememberedImages(source, self.root)

    def training_samples(self) -> TrainingImages:
        """Samples `TrainingSample`."""
        source = self.source("train")
        return TrainingImages(
            source, self.representation, self.drawn_from, self.inputs, self.color_jitter
        )

    def evaluation_samples(self, split: Split) -> EvaluationImages:
        """Samples `EvaluationSample`."""
        return EvaluationImages(self.source(split), self.representation, self.inputs)

    def normalized(self, batch: Any) -> Tensor:
        """The images of a `TrainingSample` or `EvaluationSample`."""
        return normalize(batch.images, self.normalization, self.inputs)

    def collate(self) -> Callable[[list[Any]], Any]:
        """One sample alone is not copied."""
        return collate

    def class_weights(self, kind: ClassWeights) -> Tensor:
        """Weights of the classes in the loss, from the labels of the training split.

        Args:
            kind: See `class_weights.class_weights`.

        Raises:
            SettingError: Another kind.
        """
        counts = np.zeros(len(self.class_names), np.int64)
        if kind != "none":
            source = self.source("train")
            for found in in_threads(source.label_counts, len(source)):
                counts += found[: len(counts)]
        return class_weights(counts, kind)


def checked_inputs(inputs: Sequence[Input]) -> tuple[Input, ...]:
    """Names of inputs in the order of their channels.

    Raises:
        SettingError: One is unknown or there twice, or RGB is missing.
    """
    ordered = tuple(name for name in INPUTS if name in inputs)
    known = not isinstance(inputs, str) and sorted(ordered) == sorted(inputs)
    if not known or "rgb" not in inputs:
        raise SettingError(
            "data.inputs",
            found=inputs if isinstance(inputs, str) else list(inputs),
            expected="a list: rgb, perhaps depth and elevation",
        )
    return ordered
