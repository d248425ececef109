"""What the data modules of all data sets share: loaders, normalization, class weights, resuming."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, TypeVar

import cv2
import numpy as np
import torch
from lightning import LightningDataModule
from torch.utils.data import DataLoader, Dataset

from datamodules.class_weights import ClassWeights, class_weights
from datamodules.samples import (
    RGB_NORMALIZATION,
    RGBD_NORMALIZATION,
    EvaluationImages,
    EvaluationSample,
    Inputs,
    Normalization,
    TrainingImages,
    TrainingSample,
    collate,
    normalize,
)
from datamodules.sampling import EpochSampler
from datamodules.sources import ImageSource, LabelledImage, RememberedImages, in_threads
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from torch import Tensor

__all__ = ["SegmentationDataModule", "Split"]

Split = Literal["train", "val", "test"]
"""A part of a data set."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
"""All of them."""

_INPUTS = (("rgb",), ("rgb", "depth"))
_Image = TypeVar("_Image", bound=LabelledImage)
_Sample = TypeVar("_Sample")


class SegmentationDataModule(LightningDataModule, ABC, Generic[_Image]):
    """Labelled images of one data set, split for training, validation and test.

    A data set says which images it has (`find_splits`) and its `class_names`.

    The trainer must be made with ``use_distributed_sampler=False``, see `EpochSampler`.

    Args:
        representation: What the network sees of an image.
        images_per_step: Images per training step and process. Evaluation takes one at a time.
        inputs: `rgb`, or `rgb` and `depth`.
        num_workers: Worker processes of a loader; the samples are the same for any number.
        seed: Seed of order, views, augmentation and turns, 0 or more.
        stream: Another number draws another order, other views and colours from the same seed: who
            trains on, a network that has seen those of stream 0, sees new ones.
        in_memory: Keep decoded images in memory, see `RememberedImages`.
        color_jitter: Strength of the colour augmentation, 0 (none) to 1, see `jitter_colors`.
        normalization: Of the input channels; by default that of Stanford2D3DS.

    Attributes:
        class_names: Name of every label, the unknown one (0) first.
        noun: What an image of the data set is called, in the plural.
        inputs: As given.
        in_channels: 3, or 4 with depth.
        normalization: As given, or the default.
        root: Folder of the data set.
        validation_fraction: Share of what is for training that is kept for validation.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names: tuple[str, ...]
    noun: ClassVar[str]
    root: Path
    validation_fraction: float

    def __init__(
        self,
        representation: Any,
        images_per_step: int,
        *,
        inputs: Sequence[str] = ("rgb", "depth"),
        num_workers: int = 0,
        seed: int = 0,
        stream: int = 0,
        in_memory: bool = False,
        color_jitter: float = 0.0,
        normalization: Normalization | None = None,
    ) -> None:
        super().__init__()
        self.representation = representation
        self.inputs = tuple(inputs)
        if self.inputs not in _INPUTS:
            raise SettingError(
                "data.inputs", found=list(self.inputs), expected="[rgb] or [rgb, depth]"
            )
        default = RGBD_NORMALIZATION if self.with_depth else RGB_NORMALIZATION
        self.normalization = normalization or default
        self.in_channels = default.channels
        if self.normalization.channels != self.in_channels:
            raise SettingError(
                "data.normalization",
                found=f"{self.normalization.channels} channels",
                expected=f"{self.in_channels}, for data.inputs={list(self.inputs)}",
            )
        self._per_step = f"{self.noun}_per_step"
        self.images_per_step = _at_least(f"data.{self._per_step}", images_per_step, 1)
        self.num_workers = _at_least("data.num_workers", num_workers, 0)
        self.seed = _at_least("data.seed", seed, 0)
        self._drawn_from = self.seed, _at_least("data.stream", stream, 0)
        self.in_memory = in_memory
        if not isinstance(color_jitter, int | float) or not 0 <= color_jitter <= 1:
            raise SettingError("data.color_jitter", found=color_jitter, expected="0 to 1")
        self.color_jitter = color_jitter
        self._splits: Mapping[Split, ImageSource[_Image]] = {}
        self._sources: dict[Split, ImageSource[_Image]] = {}
        self._start = (0, 0)

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

    def setup(self, stage: str | None = None) -> None:
        """Find the images, once, see `find_splits`.

        Args:
            stage: Ignored: what a test will need is checked before training already.
        """
        if not self._splits:
            self._splits = self.find_splits()

    def open_split(self, split: Split) -> ImageSource[_Image]:
        """The images of one split as they are on disk."""
        self.setup()
        return self._splits[split]

    def make_files(self) -> None:
        """Make the files of the data set, where it is one that is made."""

    def prepare_data(self) -> None:
        """Make the files."""
        self.make_files()

    def prepare_all(self) -> None:
        """Make and check all that there is to make and check before any run."""
        self.make_files()
        self.setup("fit")

    def source(self, split: Split) -> ImageSource[_Image]:
        """The images of one split: in memory, if asked for."""
        if split not in self._sources:
            source = self._opened(split)
            self._sources[split] = RememberedImages(source) if self.in_memory else source
        return self._sources[split]

    def _opened(self, split: Split) -> ImageSource[_Image]:
        return self.open_split(split)

    def sample_name(self, split: Split, index: int) -> str:
        """A short name of the image that has this index in the samples of the split."""
        return self.source(split).name(index)

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

    def state_dict(self) -> dict[str, int]:
        """Where training is: the epoch, and the batches of it that are done."""
        trainer = self.trainer
        if trainer is None:
            return {}
        epoch = trainer.current_epoch
        batches = trainer.fit_loop.epoch_loop.batch_progress.current.ready
        if batches >= trainer.num_training_batches:
            epoch, batches = epoch + 1, 0
        return {
            "epoch": epoch,
            "batches": batches,
            self._per_step: self.images_per_step,
            "processes": trainer.world_size,
        }

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Let the next training loader go on there, in the same order with the same views.

        Raises:
            SettingError: Other processes or batches would divide the epoch differently.
        """
        processes = 1 if self.trainer is None else self.trainer.world_size
        now = processes, self.images_per_step
        before = state_dict["processes"], state_dict[self._per_step]
        if state_dict["batches"] and now != before:
            raise SettingError(
                f"trainer.devices and data.{self._per_step}",
                found=f"{now[0]} processes of {now[1]} {self.noun}",
                expected=f"{before[0]} of {before[1]}, as before",
                remedy="Within an epoch, resume as the run was started.",
            )
        self._start = state_dict["epoch"], state_dict["batches"] * self.images_per_step

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Normalize the images of a batch, on the device they are on now.

        Args:
            batch: A `TrainingSample` or `EvaluationSample` of a loader.
            dataloader_idx: Ignored.

        Returns:
            The same with float32 images, channels first.
        """
        images = normalize(batch.images, self.normalization)
        if self.trainer is not None:  # which converted the batch when it had no float images yet
            images = self.trainer.precision_plugin.convert_input(images)
        return batch._replace(images=images)

    def train_dataloader(self) -> DataLoader[TrainingSample[Inputs]]:
        """Batches of `TrainingSample`."""
        source = self.source("train")
        dataset = TrainingImages(source, self.representation, self._drawn_from, self.color_jitter)
        size = self.images_per_step
        return self._loader(dataset, len(source), size, self._start, shuffle=True)

    def val_dataloader(
        self,
    ) -> DataLoader[EvaluationSample[Inputs]] | list[DataLoader[EvaluationSample[Inputs]]]:
        """Batches of one `EvaluationSample`; no loader when there is no validation split."""
        return self._evaluation_loader("val") if len(self.source("val")) else []

    def test_dataloader(self) -> DataLoader[EvaluationSample[Inputs]]:
        """Batches of one `EvaluationSample`."""
        return self._evaluation_loader("test")

    def _evaluation_loader(self, split: Split) -> DataLoader[EvaluationSample[Inputs]]:
        source = self.source(split)
        dataset = EvaluationImages(source, self.representation)
        return self._loader(dataset, len(source), 1, shuffle=False)

    def _loader(
        self,
        dataset: Dataset[_Sample],
        length: int,
        batch_size: int,
        start: tuple[int, int] = (0, 0),
        *,
        shuffle: bool,
    ) -> DataLoader[_Sample]:
        rank, world_size = _process()
        return DataLoader(
            dataset,
            batch_size=batch_size,
            sampler=EpochSampler(length, self._drawn_from, shuffle, rank, world_size, start),
            # Its own: the loader draws seeds for its workers, which would shift those of dropout.
            generator=torch.Generator().manual_seed(self.seed),
            num_workers=self.num_workers,
            persistent_workers=self.num_workers > 0,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=_opencv_without_threads,
            collate_fn=collate,
        )


def _process() -> tuple[int, int]:
    """Rank and number of processes of this run."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def _opencv_without_threads(_worker: int) -> None:
    # The workers are the parallelism; threads inside them would only fight over the cores. Not 1:
    # that waits for threads which the parent had and the forked worker does not.
    cv2.setNumThreads(0)


def _at_least(name: str, value: int, least: int) -> int:
    if value < least:
        raise SettingError(name, found=value, expected=f"{least} or more")
    return value
