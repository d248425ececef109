"""What the data modules of all panorama data sets share: loaders, normalization, class weights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar

import cv2
import numpy as np
import torch
from lightning import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from datamodules.panoramas import (
    FileSource,
    PanoramaSource,
    RememberedPanoramas,
    Turn,
    TurnedPanoramas,
    in_threads,
)
from datamodules.samples import (
    RGB_NORMALIZATION,
    RGBD_NORMALIZATION,
    EvaluationPanoramas,
    EvaluationSample,
    Inputs,
    Normalization,
    TrainingPanoramas,
    TrainingSample,
    collate,
    normalize,
)
from datamodules.sampling import EpochSampler
from datamodules.store import PreparedPanoramas, prepare_store
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tangent_train.rendering.representation import Representation

__all__ = ["ClassWeights", "PanoramaDataModule", "Split"]

Split = Literal["train", "val", "test"]
"""A part of a data set."""

ClassWeights = Literal["log", "sqrt", "none"]
"""How the loss weighs classes; see `PanoramaDataModule.class_weights`."""

_SPLITS: tuple[Split, ...] = ("train", "val", "test")
_LOG_OFFSET = 1.02
_HALF_TURN_DEG = 180
_INPUTS = (("rgb",), ("rgb", "depth"))
_Sample = TypeVar("_Sample")


class PanoramaDataModule(LightningDataModule, ABC):
    """Panoramas of one data set, split for training, validation and test.

    A data set says which panoramas it has (`open_split`), its `class_names`, and checks its files
    in `setup`. The trainer must be made with ``use_distributed_sampler=False``, see
    `EpochSampler`.

    Args:
        representation: What the network sees of a panorama.
        inputs: `rgb`, or `rgb` and `depth`.
        panoramas_per_step: Panoramas per training step and process. Evaluation takes one at a time.
        num_workers: Worker processes of a loader; the samples are the same for any number.
        seed: Seed of order, faces, augmentation and turns, 0 or more.
        in_memory: Keep decoded panoramas in memory, see `RememberedPanoramas`.
        store: Folder of a prepared store, see `store`: panoramas are decoded once, then read from
            there. The samples are the same without.
        color_jitter: Strength of the colour augmentation, 0 (none) to 1, see `jitter_colors`.
        normalization: Of the input channels; by default that of Stanford2D3DS.
        test_rotation: Turn the test panoramas: tilt in degrees, or `so3`, see `TurnedPanoramas`.

    Attributes:
        class_names: Name of every label, the unknown one (0) first.
        inputs: As given.
        in_channels: 3, or 4 with depth.
        normalization: As given, or the default.
        erp_height: Rows of the panoramas read.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names: ClassVar[tuple[str, ...]]

    def __init__(
        self,
        representation: Representation,
        *,
        inputs: Sequence[str] = ("rgb", "depth"),
        panoramas_per_step: int = 4,
        num_workers: int = 0,
        seed: int = 0,
        in_memory: bool = False,
        store: str | Path | None = None,
        color_jitter: float = 0.0,
        normalization: Normalization | None = None,
        test_rotation: Turn = None,
    ) -> None:
        super().__init__()
        self.representation = representation
        self.erp_height = representation.erp_height
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
        self.panoramas_per_step = _at_least("data.panoramas_per_step", panoramas_per_step, 1)
        self.num_workers = _at_least("data.num_workers", num_workers, 0)
        self.seed = _at_least("data.seed", seed, 0)
        self.in_memory = in_memory
        self.store = None if store is None else Path(store)
        if not isinstance(color_jitter, int | float) or not 0 <= color_jitter <= 1:
            raise SettingError("data.color_jitter", found=color_jitter, expected="0 to 1")
        self.color_jitter = color_jitter
        self.test_rotation = _checked_rotation(test_rotation)
        self._sources: dict[Split, PanoramaSource] = {}
        self._start = (0, 0)

    @property
    def with_depth(self) -> bool:
        """Whether depth is an input."""
        return "depth" in self.inputs

    @abstractmethod
    def open_split(self, split: Split) -> FileSource:
        """The panoramas of one split as they are on disk."""

    def make_files(self) -> None:
        """Make the files of the data set, where it is one that is made."""

    def prepare_data(self) -> None:
        """Make the files, and what the store lacks if there is to be one.

        An evaluation prepares the panoramas of the test split only. Before training, those that are
        opened long after its beginning are read whole: damage shows now, and is mended.
        """
        self.make_files()
        if self.trainer is not None and self.trainer.state.fn == TrainerFn.TESTING:
            self.prepare_store(("test",))
        else:
            self.prepare_store(whole=("val", "test"))

    def prepare_store(
        self, splits: Sequence[Split] = _SPLITS, *, whole: Sequence[Split] = ()
    ) -> None:
        """Make the panoramas that the store lacks; nothing without a store.

        Args:
            splits: Which.
            whole: Those of them whose files are read, for damage that does not show otherwise.

        Raises:
            DataError: The disk is too full, or a file of the data set is broken.
        """
        if self.store is not None:
            sources = {s: PreparedPanoramas(self.open_split(s), self.store) for s in splits}
            prepare_store(list(sources.values()), whole=[sources[split] for split in whole])

    def source(self, split: Split) -> PanoramaSource:
        """The panoramas of one split: from the store, turned, in memory, if asked for."""
        if split not in self._sources:
            files = self.open_split(split)
            source: PanoramaSource = files
            if self.store is not None:
                source = PreparedPanoramas(files, self.store)
            if split == "test" and self.test_rotation is not None:
                source = TurnedPanoramas(source, self.test_rotation, self.seed)
            self._sources[split] = RememberedPanoramas(source) if self.in_memory else source
        return self._sources[split]

    def sample_name(self, split: Split, index: int) -> str:
        """A short name of the panorama that has this index in the samples of the split."""
        return self.source(split).name(index)

    def class_weights(self, kind: ClassWeights) -> Tensor:
        """Weights of the classes in the loss, from the labels of the training split.

        With r the share of a class among the pixels that have one: `log` is ``1 / ln(1.02 + r)``
        (released code of the paper), `sqrt` is ``1 / √r`` scaled to a mean of 1, `none` is 1.

        Args:
            kind: Which.

        Returns:
            ``(classes,)`` float32, 0 for the unknown label and for classes never seen.

        Raises:
            SettingError: Another kind.
        """
        if kind not in ("log", "sqrt", "none"):
            raise SettingError("class weights", found=repr(kind), expected="log, sqrt or none")
        weights = np.ones(len(self.class_names))
        if kind != "none":
            counts = np.zeros(len(self.class_names), np.int64)
            source = self.source("train")
            for found in in_threads(source.label_counts, len(source)):
                counts += found[: len(counts)]
            counts[0] = 0
            seen = counts > 0
            ratio = counts[seen] / counts.sum()
            weights[~seen] = 0
            if kind == "log":
                weights[seen] = 1 / np.log(_LOG_OFFSET + ratio)
            else:
                weights[seen] = 1 / np.sqrt(ratio)
                weights[seen] /= weights[seen].mean()
        weights[0] = 0
        return torch.from_numpy(weights.astype(np.float32))

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
            "panoramas_per_step": self.panoramas_per_step,
            "processes": trainer.world_size,
        }

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Let the next training loader go on there, in the same order with the same faces.

        Raises:
            SettingError: Other processes or batches would divide the epoch differently.
        """
        processes = 1 if self.trainer is None else self.trainer.world_size
        now = {"panoramas_per_step": self.panoramas_per_step, "processes": processes}
        before = {name: state_dict[name] for name in now}
        if state_dict["batches"] and now != before:
            raise SettingError(
                "trainer.devices and data.panoramas_per_step",
                found=f"{processes} processes of {self.panoramas_per_step} panoramas",
                expected="{processes} of {panoramas_per_step}, as before".format(**before),
                remedy="Within an epoch, resume as the run was started.",
            )
        self._start = state_dict["epoch"], state_dict["batches"] * self.panoramas_per_step

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
        dataset = TrainingPanoramas(source, self.representation, self.seed, self.color_jitter)
        size = self.panoramas_per_step
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
        dataset = EvaluationPanoramas(source, self.representation)
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
            sampler=EpochSampler(length, self.seed, shuffle, rank, world_size, start),
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


def _checked_rotation(rotation: object) -> Turn:
    if rotation is None:
        return None
    if rotation == "so3":
        return "so3"
    if isinstance(rotation, int | float) and 0 <= rotation <= _HALF_TURN_DEG:
        return float(rotation)
    raise SettingError(
        "data.test_rotation",
        found=repr(rotation),
        expected="null, a tilt of 0 to 180 degrees, or so3",
    )
