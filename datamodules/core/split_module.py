"""Base data module of all data sets: splits, checks, the store, loaders, resuming."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from lightning import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_only, rank_zero_warn
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from datamodules.core.class_weights import ClassWeights, class_weights, label_doubts
from datamodules.core.index import SPLITS, DatasetIndex, Item, Split
from datamodules.core.inputs import Normalization
from datamodules.core.labels import PIXEL_CLASSES
from datamodules.core.loading import EpochSampler, make_loader, this_process
from datamodules.core.problems import Problems
from datamodules.core.reading import SplitReader
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.registry import is_class_name
from tangent_train.threads import in_threads

_GO_ON = (
    "tangent-check with the same data settings lists all problems; data.skip_broken=true leaves "
    "broken files out."
)
_Item = TypeVar("_Item", bound=Item)


@dataclass(kw_only=True, eq=False, repr=False)
class SplitDataModule(LightningDataModule, ABC, Generic[_Item]):
    """A data set split for training, validation and test.

    A data set is a dataclass: its fields are the settings `data.*` of a config. It defines the
    items of its splits (`find`), how they are read (`pipeline`) and their samples.

    The trainer must be made with ``use_distributed_sampler=False``, see `EpochSampler`.

    Args:
        root: Folder of the data set.
        representation: Representation of the images.
        validation_fraction: Share of the training data that is held out for validation; 0 for no
            validation.
        normalization: See `Normalization.of`; by default that of the data.
        num_workers: Worker processes of a loader; the samples are the same for any number.
        seed: Seed of order, views and augmentation, 0 or more.
        stream: Another number draws another order and other views from the same seed, so that
            fine-tuning after stream 0 does not repeat its views.
        store: Folder of a prepared store, see `store`: everything is decoded once, then read from
            there. The samples are the same without.
        in_memory: Keep decoded data in memory.
        skip_broken: Leave broken items out, after reading all once, instead of refusing.

    Attributes:
        class_names: Name of every label; the first of pixel classes is unknown, not a class.
        labels: Labels that its items have, see `datamodules.core.labels`.
        noun: Name of the items, in the plural.
        is_made: Whether `make_files` generates all of it.
        label_counts: After `check`, ``(K+1,)`` pixels of each label by split, as files have them.
        try_step: Refuses a training step of some items, before these are decoded; None before a
            task is known.

    Raises:
        SettingError: A setting is invalid.
    """

    labels: ClassVar[str] = PIXEL_CLASSES
    noun: ClassVar[str]
    is_made: ClassVar[bool] = False

    root: Path = field(kw_only=False)
    representation: Any = field(kw_only=False)
    validation_fraction: float = 0.1
    normalization: Normalization | str | Mapping[str, Sequence[float]] | None = None
    num_workers: int = 0
    seed: int = 0
    stream: int = 0
    store: Path | None = None
    in_memory: bool = False
    skip_broken: bool = False
    class_names: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        super().__init__()
        self.root = Path(self.root)
        self.store = None if self.store is None else Path(self.store)
        fine = 0 <= self.validation_fraction < 1
        self.require("validation_fraction", fine, "0 to below 1")
        for name in ("num_workers", "seed", "stream"):
            self.require(name, getattr(self, name) >= 0, "0 or more")
        self.require(self._per_step, self.per_step >= 1, "1 or more")
        self.label_counts: dict[Split, NDArray[np.int64]] = {}
        self.try_step: Callable[[int], None] | None = None
        self._index: DatasetIndex[_Item] | None = None
        self._sources: dict[Split, SplitReader[_Item, Any]] = {}
        self._start = (0, 0)

    # --- what a kind of data says ------------------------------------------------------------

    @abstractmethod
    def find(self, problems: Problems) -> DatasetIndex[_Item]:
        """Find the items of all splits and check them without decoding.

        Args:
            problems: Problems are added; broken items are found nevertheless.

        Raises:
            DataError: The data set as a whole cannot be used.
        """

    @abstractmethod
    def split_reader(self, index: DatasetIndex[_Item], split: Split) -> SplitReader[_Item, Any]:
        """Reading pipeline of the items of a split."""

    @abstractmethod
    def training_samples(self) -> Dataset[Any]:
        """Samples of the training split, by (epoch, index)."""

    @abstractmethod
    def evaluation_samples(self, split: Split) -> Dataset[Any]:
        """Samples of a whole split, by (epoch, index); the epoch changes nothing."""

    @property
    @abstractmethod
    def in_channels(self) -> int:
        """Number of input channels."""

    @abstractmethod
    def normalized(self, batch: Any) -> Tensor:
        """The images of a batch, normalized for the network."""

    def make_files(self) -> None:
        """Generate the files of the data set, if it is a synthetic one."""

    # --- checks --------------------------------------------------------------------------------

    def require(self, setting: str, fine: bool, expected: str, remedy: str = "") -> None:
        """Refuse the value of a setting ``data.<setting>`` that is not fine.

        Raises:
            SettingError: It is not.
        """
        if not fine:
            found = getattr(self, setting)
            found = list(found) if isinstance(found, tuple) else found
            raise SettingError(f"data.{setting}", found=found, expected=expected, remedy=remedy)

    def set_normalization(self, default: Normalization, channels: int) -> None:
        """Settle the normalization, which is a `Normalization` from now on.

        Args:
            default: Where none is set.
            channels: Required number of channels.

        Raises:
            SettingError: It is something else, or has other channels.
        """
        given = self.normalization or default
        self.normalization = Normalization.of(given, channels, "data.normalization")

    def need_representation(self, attribute: str, expected: str, remedy: str) -> None:
        """Refuse a representation of another kind of images.

        Args:
            attribute: Of all representations of the right kind.
            expected: The right kind, for the message.
            remedy: For the message.

        Raises:
            SettingError: It is of another kind.
        """
        if not hasattr(self.representation, attribute):
            raise SettingError(
                "representation",
                found=type(self.representation).__name__,
                expected=expected,
                remedy=remedy,
            )

    def setup(self, stage: str | None = None) -> None:
        """Find the items, once.

        Args:
            stage: Ignored: the test data are checked before training too.

        Raises:
            DataError: Something is broken: all that was found is named.
            SettingError: A setting does not suit the data.
        """
        self.index()

    def prepare_data(self) -> None:
        """Generate the files and complete the store; before training, decode some images.

        An evaluation prepares the test split only.

        Raises:
            DataError: Something is broken.
        """
        self.make_files()
        stage = None if self.trainer is None else self.trainer.state.fn
        self._index = index = self._usable(sample=stage == TrainerFn.FITTING)
        if self.try_step is not None and self.trainer is not None and stage == TrainerFn.FITTING:
            count = len(index.splits["train"]) // self.trainer.world_size
            for size in {min(self.per_step, count), count % self.per_step} - {0}:
                self.try_step(size)  # the last step of an epoch may be smaller
        if not self.skip_broken and index.store is not None:
            problems = Problems()
            splits: Sequence[Split] = ("test",) if stage == TrainerFn.TESTING else SPLITS
            index.read_all(splits, problems, whole=self.trainer is None)
            problems.refuse(self.root, _GO_ON)

    def prepare_part(self, part: Callable[[Sequence[_Item]], Sequence[_Item]]) -> int:
        """Complete a part of the store, as on one of several machines.

        Args:
            part: Of all items, which are listed the same way on every machine.

        Returns:
            The number of its items that are in the store.

        Raises:
            DataError: Something in it is broken.
            SettingError: There is no store.
        """
        self.make_files()
        problems = Problems()
        index = self._checked(problems)
        if index.store is None:
            expected = "a folder: files of the store are all that can be prepared in parts"
            raise SettingError("data.store", found="none, with shard=", expected=expected)
        if not self.skip_broken:
            problems.refuse(self.root, _GO_ON)
        items = part(index.of())
        part_of = replace(index, splits={"train": items, "val": [], "test": []})
        part_of.read_all(SPLITS, problems, whole=True)
        if not self.skip_broken:
            problems.refuse(self.root, _GO_ON)
        return len(problems.without(items))

    def index(self) -> DatasetIndex[_Item]:
        """Items found by `setup`."""
        if self._index is None:
            self._index = self._usable()
        return self._index

    def check(self) -> tuple[Problems, int]:
        """Read the whole data set, and count its labels; nothing is generated or written.

        Returns:
            All problems, and the number of images or shapes read.
        """
        problems, count = Problems(), 0
        of_images: dict[str, NDArray[np.int64]] = {}
        with problems.noted():
            if self.is_made and not self.root.is_dir():
                raise DataError(
                    self.root,
                    found="no such folder",
                    expected="the data set",
                    remedy="Run tangent-prepare with the same settings.",
                )
            index = self._listed(problems)
            count = index.check(problems, of_images)
            for split in SPLITS:
                counts = [of_images[i.name] for i in index.splits[split] if i.name in of_images]
                none = np.zeros(len(self.class_names), np.int64)
                self.label_counts[split] = np.sum([none, *counts], axis=0)
        return problems, count

    def check_classes(self) -> None:
        """Check that the data set names its classes, in names that checkpoints can hold.

        Raises:
            SettingError: It does not.
        """
        names = getattr(self, "class_names", ())
        if not names or (self.labels == PIXEL_CLASSES and names[0] != "unknown"):
            raise SettingError(
                f"class_names of {type(self).__name__}",
                found=f"{names[0]} first" if names else "none",
                expected="unknown, then the classes: label 0 is ignored",
            )
        strange = [name for name in names if not is_class_name(name)]
        if strange:
            raise SettingError(
                f"class_names of {type(self).__name__}",
                found=repr(strange[0]),
                expected="names without control characters and line ends",
            )

    def _listed(self, problems: Problems) -> DatasetIndex[_Item]:
        """Items of all splits, with the checks that hold for every data set."""
        self.check_classes()
        index = self.find(problems)
        if not index.of() and not problems.items:
            expected = f"{self.noun}, as docs and the docstring of the data set describe them"
            raise DataError(self.root, found=f"no {self.noun}", expected=expected)
        return index

    def _checked(self, problems: Problems) -> DatasetIndex[_Item]:
        """Items with files that look whole, or broken ones; refuse a data set that has none."""
        index: Any = None
        with problems.noted():
            index = self._listed(problems)
        if problems.fatal:
            problems.refuse(self.root)
        return index

    def _usable(self, *, sample: bool = False) -> DatasetIndex[_Item]:
        """Usable items; refuse the data set if one is broken, unless broken ones are left out."""
        problems = Problems()
        index = self._checked(problems)
        if not self.skip_broken:
            if sample and self.store is None:
                index.read_some(self.seed, problems)
            problems.refuse(self.root, _GO_ON)
            return index
        index.read_all(SPLITS, problems, whole=self.trainer is None)
        left = index.without(problems)
        for split in SPLITS:
            if index.splits[split] and not left.splits[split]:
                raise DataError(
                    self.root,
                    found=f"no {self.noun} for {split} that can be used",
                    expected="one or more",
                    remedy="tangent-check lists their problems.",
                )
        if problems.items:
            total = len(problems.items.union(item.name for item in index.of()))
            tell(
                f"{len(problems.items)} of {total} {self.noun} are broken and left out "
                "(data.skip_broken=true); tangent-check lists them."
            )
        return left

    # --- samples and loaders -------------------------------------------------------------------

    @property
    def num_classes(self) -> int:
        """Classes K: the scores of a network."""
        return len(self.class_names) - (self.labels == PIXEL_CLASSES)

    def class_weights(self, kind: ClassWeights) -> Tensor:
        """Weights of the classes in the loss, from the labels of the training split.

        Labels that seem to be of other classes are warned of.

        Args:
            kind: See `class_weights.class_weights`.
        """
        counts = np.zeros(len(self.class_names), np.int64)
        if kind != "none":
            source = self.source("train")
            for labels in in_threads(source.labels, range(len(source))):
                counts += np.bincount(labels.ravel(), minlength=len(counts))
            for doubt in label_doubts("train", counts, self.class_names):
                tell(f"Warning: {doubt}")
        return class_weights(counts[1:], kind)

    def source(self, split: Split) -> SplitReader[_Item, Any]:
        """The images of one split: in memory, if asked for."""
        if split not in self._sources:
            source = self.split_reader(self.index(), split)
            if self.in_memory:
                source.remember(self.root)
            self._sources[split] = source
        return self._sources[split]

    def sample_name(self, split: Split, index: int) -> str:
        """Short name of the sample with this index in the split."""
        return self.source(split).name(index)

    @property
    def per_step(self) -> int:
        """Images or shapes per training step and process."""
        return int(getattr(self, self._per_step))

    @property
    def _per_step(self) -> str:
        return f"{self.noun}_per_step"

    def evaluation_size(self) -> int:
        """Samples of a batch in validation and test."""
        return 1

    def state_dict(self) -> dict[str, int]:
        """Training position: the epoch, and its finished batches."""
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
            self._per_step: self.per_step,
            "processes": trainer.world_size,
        }

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Let the next training loader continue there, with the same order and views.

        Raises:
            SettingError: Other processes or batches would divide the epoch differently.
        """
        processes = 1 if self.trainer is None else self.trainer.world_size
        now = processes, self.per_step
        before = state_dict["processes"], state_dict[self._per_step]
        if state_dict["batches"] and now != before:
            raise SettingError(
                f"trainer.devices and data.{self._per_step}",
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
        rank, world_size = this_process()
        count = len(self.source(split))
        left_out = count % world_size
        if shuffle and left_out:
            rank_zero_warn(
                f"{left_out} of {count} training {self.noun}, others every time, are left "
                f"out of each epoch: {world_size} processes take as many each.",
                category=UserWarning,
            )
        seed = self.seed, self.stream
        sampler = EpochSampler(count, seed, shuffle, rank, world_size, start)
        return make_loader(dataset, sampler, batch_size, self.num_workers, self.seed)


@rank_zero_only
def tell(text: str) -> None:
    """Print text as it is, in the first process."""
    print_text(text)
