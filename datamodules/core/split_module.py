"""Data module of all data sets: preparation, loaders, resuming."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from lightning import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_warn
from torch.utils.data import DataLoader, Dataset, Sampler

from datamodules.core.index import SPLITS, Item, Split
from datamodules.core.labeled_data import REMEDY, LabeledData
from datamodules.core.loading import (
    EpochSampler,
    ResumedOrder,
    make_loader,
    share_of_process,
    this_process,
)
from datamodules.core.problems import Problems
from tangent_train.errors import DataError, SettingError

_Item = TypeVar("_Item", bound=Item)


@dataclass(kw_only=True, eq=False, repr=False)
class SplitDataModule(LabeledData[_Item], LightningDataModule):
    """A `LabeledData` with loaders for a trainer.

    Create the trainer with ``use_distributed_sampler=False``, see `EpochSampler`.

    Args:
        num_workers: Number of worker processes of a loader; samples do not depend on it.

    Attributes:
        try_step: Function that refuses an impossible training step before data are decoded; None
            before the task is known.

    Raises:
        SettingError: A setting is invalid.
    """

    num_workers: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("num_workers", self.num_workers >= 0, "0 or more")
        self.require(self._per_step, self.per_step >= 1, "1 or more")
        self.try_step: Callable[[int], None] | None = None
        self._start = (0, 0)

    @property
    def per_step(self) -> int:
        """Images or shapes per training step and process."""
        return int(getattr(self, self._per_step))

    @property
    def _per_step(self) -> str:
        return "batch_size"

    def evaluation_size(self) -> int:
        """Number of samples in a batch of validation and test."""
        return 1

    # --- preparation ---------------------------------------------------------------------------

    def prepare_data(self) -> None:
        """Generate the files and complete the store; before training, decode some images.

        An evaluation prepares the test split only.

        Raises:
            DataError: An item is broken.
        """
        self.make_files()
        stage = None if self.trainer is None else self.trainer.state.fn
        whole = self.trainer is None
        if self._index is None or not self.skip_broken:
            self._index = self._find_usable(sample=stage == TrainerFn.FITTING, whole=whole)
        index = self._index
        if stage == TrainerFn.FITTING and not index.splits["train"]:
            raise DataError(
                self.root,
                found=f"no {self.noun} for training",
                expected="one or more",
                remedy="Train on other data; these are for tangent-evaluate and tangent-transfer.",
            )
        if self.try_step is not None and self.trainer is not None and stage == TrainerFn.FITTING:
            count = len(index.splits["train"]) // self.trainer.world_size
            for size in {min(self.per_step, count), count % self.per_step} - {0}:
                self.try_step(size)  # the last step of an epoch may be smaller
        if not self.skip_broken and index.store is not None:
            problems = Problems()
            splits: Sequence[Split] = ("test",) if stage == TrainerFn.TESTING else SPLITS
            index.read_all(index.of(splits), problems, whole=whole)
            problems.refuse(self.root, REMEDY)

    def setup(self, stage: str | None = None) -> None:
        """Find and check the items once; other processes of the run take the index of the first.

        Args:
            stage: Ignored, because the test data are checked before training too.

        Raises:
            DataError: Something is broken; the message names all problems.
            SettingError: A setting does not suit the data.
        """
        if self.trainer is not None:
            # Only the first process has run `prepare_data`; others need not read everything again.
            self._index = self.trainer.strategy.broadcast(self._index)
        self.index()

    # --- loaders -------------------------------------------------------------------------------

    def train_dataloader(self) -> DataLoader[Any]:
        """Return the training batches; with ``overfit_batches``, the same views in every epoch."""
        if getattr(self.trainer, "overfit_batches", 0):
            share: Any = share_of_process(self.dataset("train"))
            return self._loader(share, self.per_step, ResumedOrder(share, self._start[1]))
        rank, world_size = this_process()
        count = len(self.source("train"))
        if left_out := count % world_size:
            rank_zero_warn(
                f"{left_out} of {count} training {self.noun}, different ones each time, are left "
                f"out of each epoch: {world_size} processes take equally many.",
                category=UserWarning,
            )
        seed = self.seed, self.sampling_seed
        sampler = EpochSampler(count, seed, rank, world_size, self._start)
        return self._loader(self.dataset("train"), self.per_step, sampler)

    def val_dataloader(self) -> DataLoader[Any] | list[DataLoader[Any]]:
        """Return the validation batches; no loader without a validation split."""
        return self._evaluation_loader("val") if len(self.source("val")) else []

    def test_dataloader(self) -> DataLoader[Any]:
        """Return the test batches."""
        return self._evaluation_loader("test")

    def _evaluation_loader(self, split: Split) -> DataLoader[Any]:
        return self._loader(share_of_process(self.dataset(split)), self.evaluation_size())

    def _loader(
        self, dataset: Dataset[Any], batch_size: int, sampler: Sampler[Any] | None = None
    ) -> DataLoader[Any]:
        return make_loader(dataset, batch_size, self.num_workers, self.seed, sampler)

    def on_after_batch_transfer(self, batch: Any, dataloader_idx: int) -> Any:
        """Normalize the images of a batch on their current device.

        Args:
            batch: A collated sample of a loader.
            dataloader_idx: Ignored.

        Returns:
            The batch with float32 images, channels first.
        """
        images = self.normalized(batch)
        if self.trainer is not None:  # which converted the batch when it had no float images yet
            images = self.trainer.precision_plugin.convert_input(images)
        return batch._replace(images=images)

    # --- resuming ------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, int]:
        """Return the training position: the epoch and its finished batches."""
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
        """Make the next training loader continue at this position, with the same order and views.

        Raises:
            SettingError: Another number of processes or batch size divides the epoch differently.
        """
        processes = 1 if self.trainer is None else self.trainer.world_size
        now = processes, self.per_step
        before = state_dict["processes"], state_dict[self._per_step]
        if state_dict["batches"] and now != before:
            raise SettingError(
                f"trainer.devices and data.{self._per_step}",
                found=f"{now[0]} processes of {now[1]} {self.noun}",
                expected=f"{before[0]} of {before[1]}, as in the interrupted run",
                remedy="Within an epoch, resume as the run was started.",
            )
        self._start = state_dict["epoch"], state_dict["batches"] * self.per_step
