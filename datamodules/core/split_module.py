"""What the data modules of all data sets share: splits, loaders, the order of samples, resuming."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Protocol, TypeVar

import cv2
import torch
from lightning import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_warn
from torch.utils.data import DataLoader, Dataset

from datamodules.core.data_check import find_usable
from datamodules.core.problems import Problems
from datamodules.core.samples import Normalization
from datamodules.core.sampling import EpochSampler
from datamodules.core.watched_samples import WatchedLoader, WatchedSamples, explained
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from torch import Tensor

__all__ = ["SPLITS", "Kind", "Source", "Split", "SplitDataModule", "at_least"]

Split = Literal["train", "val", "test"]
"""A part of a data set."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
"""All of them."""


Kind = Literal["segmentation", "classification"]
"""What a data set is labelled for: classes of pixels, or of whole shapes."""


class Source(Protocol):
    """What a split has, by number."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def name(self, index: int) -> str:
        """A short name of one of them, which no other has."""
        ...


_Source = TypeVar("_Source", bound=Source)


class SplitDataModule(LightningDataModule, ABC, Generic[_Source]):
    """A data set split for training, validation and test.

    A kind of data says what its splits are (`find_splits`) and how they become samples
    (`training_samples`, `evaluation_samples`, `normalized`).

    The trainer must be made with ``use_distributed_sampler=False``, see `EpochSampler`.

    Args:
        representation: What the network sees.
        per_step: Panoramas, photos or shapes (`noun`) per training step and process.
        normalization: Of the input channels.
        num_workers: Worker processes of a loader; the samples are the same for any number.
        seed: Seed of order, views, augmentation and turns, 0 or more.
        stream: Another number draws another order and other views from the same seed: who trains
            on, a network that has seen those of stream 0, sees new ones.
        in_memory: Keep what is read in memory, see `remembered`.
        skip_broken: Leave out what cannot be used, after reading all once, instead of refusing.

    Attributes:
        class_names: Name of every class.
        kind: What its labels say.
        noun: What the data set consists of, in the plural.
        in_channels: Number of input channels.
        normalization: As given.
        root: Folder of the data set.
        validation_fraction: Share of what is for training that is kept for validation.
        is_made: Whether `make_files` makes all of it.
        problems: What `find_splits` found to be wrong.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names: tuple[str, ...]
    kind: ClassVar[Kind]
    noun: ClassVar[str]
    is_made: ClassVar[bool] = False
    root: Path
    validation_fraction: float

    def __init__(
        self,
        representation: Any,
        per_step: int,
        normalization: Normalization,
        *,
        num_workers: int = 0,
        seed: int = 0,
        stream: int = 0,
        in_memory: bool = False,
        skip_broken: bool = False,
    ) -> None:
        super().__init__()
        self.representation = representation
        self.normalization = normalization
        self.in_channels = normalization.channels
        self._setting = f"{self.noun}_per_step"
        self.per_step = at_least(f"data.{self._setting}", per_step, 1)
        self.num_workers = at_least("data.num_workers", num_workers, 0)
        self.seed = at_least("data.seed", seed, 0)
        self.drawn_from = self.seed, at_least("data.stream", stream, 0)
        self.in_memory = in_memory
        self.skip_broken = skip_broken
        self.problems = Problems()
        self._splits: Mapping[Split, _Source] = {}
        self._sources: dict[Split, _Source] = {}
        self._start = (0, 0)
        self._watched: dict[Split, WatchedSamples] = {}

    @abstractmethod
    def find_splits(self) -> Mapping[Split, _Source]:
        """What all splits have as it is on disk, checked without reading all of it.

        What is wrong with some of it is noted in `problems`, and left out here.

        Raises:
            DataError: Something is missing or cannot be used.
            SettingError: It does not fit the representation.
        """

    @abstractmethod
    def content(self, splits: Mapping[Split, _Source]) -> tuple[int, Iterator[None]]:
        """All that there is to read, whole, to note in `problems` what is broken.

        Args:
            splits: From `find_splits`.

        Returns:
            How many images or shapes, and what reads one after the other and yields each time.
        """

    def readable(self, splits: Mapping[Split, _Source]) -> Mapping[Split, _Source]:
        """The same without what turns out to be broken when all is read, noted in `problems`."""
        return splits

    def sampled_splits(self) -> Sequence[Split]:
        """The splits to read some of before training: those that are not read whole then."""
        return ()

    @abstractmethod
    def remembered(self, source: _Source) -> _Source:
        """The same, read once, now, and kept in memory."""

    @abstractmethod
    def training_samples(self) -> Dataset[Any]:
        """Samples of the training split, by (epoch, index)."""

    @abstractmethod
    def evaluation_samples(self, split: Split) -> Dataset[Any]:
        """Samples of a whole split, by (epoch, index); the epoch changes nothing."""

    @abstractmethod
    def normalized(self, batch: Any) -> Tensor:
        """The images of a batch as the network takes them, float32, on the device they are on."""

    def collate(self) -> Callable[[list[Any]], Any] | None:
        """What makes a batch of samples; torch's own by default."""
        return None

    def evaluation_size(self) -> int:
        """Samples of a batch in validation and test."""
        return 1

    def setup(self, stage: str | None = None) -> None:
        """Find what is there, once, see `find_splits`.

        Args:
            stage: Ignored: what a test will need is checked before training already.

        Raises:
            DataError: Something is broken: all that was found is named.
            SettingError: A setting does not suit the data.
        """
        if not self._splits:
            self._splits = find_usable(self)

    def open_split(self, split: Split) -> _Source:
        """What one split has as it is on disk."""
        self.setup()
        return self._splits[split]

    def make_files(self) -> None:
        """Make the files of the data set, where it is one that is made."""

    def prepare_data(self) -> None:
        """Make the files; before training, read some of them.

        Raises:
            DataError: Something is broken.
        """
        self.make_files()
        training = self.trainer is not None and self.trainer.state.fn == TrainerFn.FITTING
        if training and not self.skip_broken:
            self._splits = find_usable(self, self.sampled_splits())

    def prepare_all(self) -> None:
        """Make and check all that there is to make and check before any run."""
        self.make_files()
        self.setup("fit")

    def source(self, split: Split) -> _Source:
        """What one split has: in memory, if asked for."""
        if split not in self._sources:
            source = self.opened(split)
            self._sources[split] = self.remembered(source) if self.in_memory else source
        return self._sources[split]

    def opened(self, split: Split) -> _Source:
        """What one split has, as it is to be read."""
        return self.open_split(split)

    def sample_name(self, split: Split, index: int) -> str:
        """A short name of what has this index in the samples of the split."""
        return self.source(split).name(index)

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
            self._setting: self.per_step,
            "processes": trainer.world_size,
        }

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Let the next training loader go on there, in the same order with the same views.

        Raises:
            SettingError: Other processes or batches would divide the epoch differently.
        """
        processes = 1 if self.trainer is None else self.trainer.world_size
        now = processes, self.per_step
        before = state_dict["processes"], state_dict[self._setting]
        if state_dict["batches"] and now != before:
            raise SettingError(
                f"trainer.devices and data.{self._setting}",
                found=f"{now[0]} processes of {now[1]} {self.noun}",
                expected=f"{before[0]} of {before[1]}, as before",
                remedy="Within an epoch, resume as the run was started.",
            )
        self._start = state_dict["epoch"], state_dict["batches"] * self.per_step

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Normalize the images of a batch, on the device they are on now.

        Args:
            batch: A collated sample of a loader.
            dataloader_idx: Ignored.

        Returns:
            The same with float32 images, channels first.
        """
        images = self.normalized(batch)
        if self.trainer is not None:  # which converted the batch when it had no float images yet
            images = self.trainer.precision_plugin.convert_input(images)
        return batch._replace(images=images)

    def train_dataloader(self) -> DataLoader[Any]:
        """Batches for training."""
        dataset = self.training_samples()
        return self._loader("train", dataset, self.per_step, self._start, shuffle=True)

    def val_dataloader(self) -> DataLoader[Any] | list[DataLoader[Any]]:
        """Batches for validation; no loader when there is no validation split."""
        return self._evaluation_loader("val") if len(self.source("val")) else []

    def test_dataloader(self) -> DataLoader[Any]:
        """Batches for the test."""
        return self._evaluation_loader("test")

    def explained(self, error: Exception) -> Exception:
        """What to tell the user of an error during training or evaluation.

        Args:
            error: It.

        Returns:
            One that names the sample that a worker process died of; or the same.
        """
        return explained(error, self._watched.values())

    def _evaluation_loader(self, split: Split) -> DataLoader[Any]:
        dataset = self.evaluation_samples(split)
        return self._loader(split, dataset, self.evaluation_size(), shuffle=False)

    def _loader(
        self,
        split: Split,
        dataset: Dataset[Any],
        batch_size: int,
        start: tuple[int, int] = (0, 0),
        *,
        shuffle: bool,
    ) -> DataLoader[Any]:
        rank, world_size = _process()
        source = self.source(split)
        left_out = len(source) % world_size
        if shuffle and left_out:
            rank_zero_warn(
                f"{left_out} of {len(source)} training {self.noun}, others every time, are left "
                f"out of each epoch: {world_size} processes take as many each.",
                category=UserWarning,
            )
        watched = WatchedSamples(dataset, source.name, self.num_workers)
        self._watched[split] = watched
        return WatchedLoader(
            watched,
            batch_size=batch_size,
            sampler=EpochSampler(len(source), self.drawn_from, shuffle, rank, world_size, start),
            # Its own: the loader draws seeds for its workers, which would shift those of dropout.
            generator=torch.Generator().manual_seed(self.seed),
            num_workers=self.num_workers,
            persistent_workers=self.num_workers > 0,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=_opencv_without_threads,
            collate_fn=self.collate(),
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


def at_least(name: str, value: int, least: int) -> int:
    """A setting that has to be `least` or more.

    Raises:
        SettingError: It is less.
    """
    if value < least:
        raise SettingError(name, found=value, expected=f"{least} or more")
    return value
