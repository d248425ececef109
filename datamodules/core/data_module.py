"""Base of all data sets: settings, files, checks, loaders, resuming."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import field
from functools import cached_property, partial, wraps
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar, dataclass_transform

import numpy as np
from lightning import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_only, rank_zero_warn
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, NonNegativeInt, PositiveInt, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from datamodules.core.cache import Cache, Files
from datamodules.core.class_weights import ClassWeights, class_weights, label_doubts
from datamodules.core.dataset import SplitDataset
from datamodules.core.labels import PIXEL_CLASSES
from datamodules.core.loading import (
    EpochSampler,
    ResumedOrder,
    make_loader,
    share_of_process,
    this_process,
)
from datamodules.core.problems import Problems
from datamodules.core.splits import SPLITS, Split
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.progress import show_progress
from tangent_train.threads import in_threads

_Class = TypeVar("_Class", bound=type[Any])

REMEDY = (
    "tangent-check with the same data settings lists all problems; data.skip_broken=true leaves "
    "broken files out."
)
"""Remedy for broken files."""


@dataclass_transform(kw_only_default=True, eq_default=False, field_specifiers=(field,))
def data_set(kind: _Class) -> _Class:
    """Make a class whose fields are the settings ``data.*`` of a data set.

    The fields are validated by their types (pydantic); an invalid one is a `SettingError`.
    """
    config = ConfigDict(arbitrary_types_allowed=True, extra="forbid")
    made: Any = pydantic_dataclass(kind, kw_only=True, eq=False, repr=False, config=config)
    init = made.__init__

    @wraps(init)
    def checked(self: Any, *values: Any, **settings: Any) -> None:
        try:
            init(self, *values, **settings)
        except ValidationError as error:
            raise _setting_error(error) from error

    made.__init__ = checked
    return made


def _setting_error(error: ValidationError) -> Exception:
    """Return the first error of a validation; errors of a field's alternatives are joined."""
    first = error.errors()[0]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, DataError | SettingError):
        return cause
    name = first["loc"][0] if first["loc"] else "data"
    texts = [e["msg"].removeprefix("Input should be ") for e in error.errors() if name in e["loc"]]
    return SettingError(
        f"data.{name}", found=first["input"], expected=" or ".join(dict.fromkeys(texts))
    )


@data_set
class DataModule(LightningDataModule, ABC):
    """A data set split for training, validation and test, with loaders for a trainer.

    Its fields are the settings `data.*` of a config. It lists the files of its splits (`files`),
    reads them (`read`), and renders samples (`build_dataset`). Create the trainer with
    ``use_distributed_sampler=False``, see `EpochSampler`.

    Args:
        root: Folder of the data set.
        representation: Representation of the images; by default `default_representation`.
        level: Level of the default representation.
        val_fraction: Share of the training data that is held out for validation; 0 for no
            validation.
        normalization: See `Normalization.of`; by default that of the data.
        batch_size: Images or shapes per training step and process.
        seed: Seed of the splits, the order, the views and the augmentation.
        sampling_seed: Further seed of the order, the views and the augmentation: with another
            number, fine-tuning does not repeat the views of the first training.
        cache: Folder for decoded data, see `Cache`. The samples are the same without.
        in_memory: Keep decoded data in memory.
        skip_broken: Read all files first and leave out broken ones, instead of refusing the data.
        num_workers: Number of worker processes of a loader; samples do not depend on it.

    Attributes:
        labels: Kind of labels, see `datamodules.core.labels`.
        noun: Name of the images or shapes, in the plural.
        kind: Named tuple of the arrays of an image or shape.
        class_names: Name of every label; for pixel labels the first is unknown, not a class. Empty
            if the labels are distances.
        fact_settings: Settings of the class that scores on the test split depend on, see `facts`.
        folds: Values of the setting ``fold``, over which published evaluations average.
        problems: Problems of the files, found so far.
        label_counts: After `check`, pixels of each of the `label_names` in the files, by split.

    Raises:
        SettingError: A setting is invalid.
    """

    noun: ClassVar[str]
    kind: ClassVar[type[Any]]
    labels: ClassVar[str] = PIXEL_CLASSES
    class_names: ClassVar[tuple[str, ...]] = ()
    fact_settings: ClassVar[tuple[str, ...]] = ()
    folds: ClassVar[tuple[int, ...]] = ()

    root: Path = field(kw_only=False)
    representation: Any = field(kw_only=False, default=None)
    level: NonNegativeInt | None = None
    val_fraction: Annotated[float, Field(ge=0, lt=1)] = 0.1
    normalization: Any = None
    batch_size: PositiveInt = 4
    seed: NonNegativeInt = 0
    sampling_seed: NonNegativeInt = 0
    cache: Path | None = None
    in_memory: bool = False
    skip_broken: bool = False
    num_workers: NonNegativeInt = 0

    def __post_init__(self) -> None:
        LightningDataModule.__init__(self)
        if self.representation is None:
            self.representation = self.default_representation()
        elif self.level is not None:
            expected = "null: the representation has a level"
            raise SettingError("data.level", found=self.level, expected=expected)
        self.problems = Problems()
        self.label_counts: dict[Split, NDArray[np.int64]] = {}
        self._splits: dict[Split, list[Any]] | None = None
        self._datasets: dict[Split, SplitDataset] = {}
        self._test_images = ""
        self._start = (0, 0)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "trainer": None, "_datasets": {}}

    # --- defined by subclasses ---------------------------------------------------------------

    @abstractmethod
    def default_representation(self) -> Any:
        """Return the representation used without a setting for it, at `level`."""

    @abstractmethod
    def files(self, split: Split) -> Sequence[Files]:
        """Return the files of every image or shape of a split, not yet opened.

        Broken files are included, so that splits do not depend on them. Warnings and problems of
        the folders are added to `problems`.

        Raises:
            DataError: The data set as a whole cannot be used.
        """

    @abstractmethod
    def read(self, files: Any) -> Any:
        """Read one image or shape as a named tuple of arrays, which the cache keeps.

        Raises:
            DataError: A file is broken.
        """

    @abstractmethod
    def build_dataset(self, split: Split) -> SplitDataset:
        """Return the samples of a split as a map-style data set of PyTorch.

        A sample of ``"train"`` holds randomly drawn views, a sample of ``"val"`` or ``"test"`` all
        views. A key is an index, or an epoch and an index: each epoch draws other views.
        """

    @property
    @abstractmethod
    def in_channels(self) -> int:
        """Number of input channels."""

    @abstractmethod
    def normalized(self, batch: Any) -> Tensor:
        """Return the images of a batch, normalized for the network."""

    def finish(self, item: Any, split: Split, index: int) -> Any:
        """Return an item that was read or cached as samples are rendered from it."""
        del split, index
        return item

    def check_files(self, files: Any) -> None:
        """Check, without decoding, that the files of an image or shape fit the settings.

        Raises:
            DataError: A file does not fit.
            SettingError: A setting does not suit the files.
        """

    def decode_settings(self) -> dict[str, Any]:
        """Return everything that `read` depends on besides the files, for the cache."""
        return {"data": type(self).__name__}

    def groups(self, files: Any) -> Sequence[str]:
        """Return the groups of an image that get rows in the results, such as its weather."""
        del files
        return ()

    def make_files(self) -> None:
        """Generate the files of a synthetic data set."""

    def evaluation_size(self) -> int:
        """Number of samples in a batch of validation and test."""
        return 1

    def in_parallel(self, work: Callable[[Any], Any], items: Sequence[Any]) -> Generator[Any]:
        """Yield results of a function for all items as they come."""
        return in_threads(work, items)

    # --- finding and checking ----------------------------------------------------------------

    def splits(self) -> dict[Split, list[Any]]:
        """Return the usable files of each split; the first call finds and checks them.

        Raises:
            DataError: Something is broken; the message names all problems.
            SettingError: A setting does not suit the data.
        """
        if self._splits is None:
            found = self._find_files()
            if self.problems.fatal:
                self.problems.refuse(self.root)
            for warning in self.problems.warnings:
                print_on_rank_zero(f"Warning: {warning}")
            if self.skip_broken:
                self._read_all(found, "Checking the data")
                found = self._without_broken(found)
            self.problems.refuse(self.root, REMEDY)
            self._splits = found
        return self._splits

    def dataset(self, split: Split) -> Any:
        """Return the data set of a split; with `in_memory`, read everything now."""
        if split not in self._datasets:
            self._datasets[split] = self.build_dataset(split)
        return self._datasets[split]

    def check(self) -> tuple[Problems, int]:
        """Read the whole data set and count its labels; generate and write nothing.

        Returns:
            All problems, and the number of images or shapes, broken ones included.
        """
        found = self._find_files()
        size = len(self.label_names)
        self.label_counts = {split: np.zeros(size, np.int64) for split in SPLITS}
        usable = {split: self.problems.without(found[split]) for split in SPLITS}
        self._read_all(usable, "Checking", self._counted)
        names = {files.name for files in chain.from_iterable(found.values())}
        return self.problems, len(names | self.problems.items)

    def count_labels(self, item: Any) -> NDArray[np.int64] | None:
        """Return the number of pixels of each of the `label_names`; None for shapes."""
        del item
        return None

    def warning(self, files: Any, item: Any) -> str:
        """Return a warning about usable files for `check`, or an empty string."""
        del files, item
        return ""

    def _find_files(self) -> dict[Split, list[Any]]:
        """Return the files of all splits; note problems of files and of the whole data set."""
        self.problems = Problems()
        for name in [*vars(self)]:  # lists of files are made anew
            if isinstance(getattr(type(self), name, None), cached_property):
                delattr(self, name)
        found: dict[Split, list[Any]] = {split: [] for split in SPLITS}
        with self.problems.noted():
            missing = f"no {self.noun}" if self.root.is_dir() else "no such folder"
            try:
                found = {split: list(self.files(split)) for split in SPLITS}
            except DataError as error:
                if self.root.is_dir():
                    raise
                given: Any = {"expected": error.expected, "remedy": error.remedy}
                raise DataError(self.root, found=missing, **given) from error
            if not any(found.values()) and not self.problems.items:
                expected = f"{self.noun}, as docs and the docstring of the data set describe them"
                raise DataError(self.root, found=missing, expected=expected)
        self._test_images = self.problems.incomplete.get(getattr(self, "test_split", "test"), "")

        def check(files: Any) -> None:
            with self.problems.noted(files.name):
                self.check_files(files)

        for _ in in_threads(check, self.problems.without(chain.from_iterable(found.values()))):
            pass
        return found

    def _read_all(
        self,
        splits: Mapping[Split, Sequence[Any]],
        description: str,
        look: Callable[[Split, Any, str], None] | None = None,
    ) -> None:
        """Read all items once, into the cache if there is one; note broken files."""
        items = [(s, files) for s in splits for files in self.problems.without(splits[s])]
        work = partial(_try_read, self, look is not None)

        def looked_at(results: Iterable[Any]) -> Generator[None]:
            for (split, files), error, found in results:
                if error is not None:
                    with self.problems.noted(files.name, files.paths[0]):
                        raise error
                elif look is not None:
                    look(split, *found)
                yield

        with closing(self.in_parallel(work, items)) as results:
            show_progress(looked_at(results), description, self.noun, len(items))

    def _counted(self, split: Split, counts: NDArray[np.int64] | None, warning: str) -> None:
        if counts is not None:
            self.label_counts[split] += counts
        self.problems.warnings += [warning] if warning else []

    def _without_broken(self, found: Mapping[Split, Sequence[Any]]) -> dict[Split, list[Any]]:
        """Return the usable files; refuse a split of which none is left."""
        usable = {split: self.problems.without(found[split]) for split in SPLITS}
        if len(usable["test"]) < len(found["test"]):
            self._test_images = f"{len(usable['test'])} of {len(found['test'])}"
        for split in SPLITS:
            if found[split] and not usable[split]:
                raise DataError(
                    self.root,
                    found=f"no {self.noun} for {split} that can be used",
                    expected="one or more",
                    remedy="tangent-check lists their problems.",
                )
        if self.problems.items:
            print_on_rank_zero(
                f"{len(self.problems.items)} {self.noun} are broken and left out "
                "(data.skip_broken=true); tangent-check lists them."
            )
        self.problems = Problems()
        return usable

    # --- reading -------------------------------------------------------------------------------

    def read_cached(self, files: Any) -> Any:
        """Read one image or shape from the cache, or from its files."""
        if self.cache is None:
            return self.read(files)
        return self._cache.read(files, partial(self.read, files))

    @cached_property
    def _cache(self) -> Cache:
        folder: Any = self.cache
        return Cache.of(folder, self.decode_settings(), self.kind)

    def prepare_data(self) -> None:
        """Generate the files and complete the cache.

        Raises:
            DataError: A file is broken.
        """
        self.make_files()
        splits = self.splits()
        fitting = self.trainer is not None and self.trainer.state.fn == TrainerFn.FITTING
        if fitting and not splits["train"]:
            raise DataError(
                self.root,
                found=f"no {self.noun} for training",
                expected="one or more",
                remedy="Train on other data; these are for tangent-evaluate and tangent-transfer.",
            )
        if self.cache is not None:
            self.fill_cache(lambda items: items)

    def fill_cache(self, part: Callable[[Sequence[Any]], Sequence[Any]]) -> int:
        """Read a part of the data into the cache, e.g. on one of several machines.

        Args:
            part: Selects some of all items, which have the same order on every machine.

        Returns:
            Number of items of the part.
        """
        splits = self.splits()
        numbered = [(split, files) for split in SPLITS for files in splits[split]]
        chosen: dict[Split, list[Any]] = {split: [] for split in SPLITS}
        for split, files in part(numbered):
            if not self._cache.path(files).is_file():
                chosen[split].append(files)
        self._read_all(chosen, f"Preparing {self.noun}")
        self.problems.refuse(self.root, REMEDY)
        return len(part(numbered))

    def setup(self, stage: str | None = None) -> None:
        """Find and check the files once; other processes of the run take those of the first.

        Args:
            stage: Ignored, because the test data are checked before training too.
        """
        if self.trainer is not None:
            # Only the first process has run `prepare_data`; others need not read everything again.
            self._splits = self.trainer.strategy.broadcast(self._splits)
        self.splits()

    # --- facts ---------------------------------------------------------------------------------

    @property
    def facts(self) -> dict[str, str]:
        """Facts that scores on the test split depend on, see `tangent_train.results.published`.

        They are the data set, the number or set of classes, the `fact_settings` of all classes, and
        the number of test images ("2 of 100") if some are missing or were left out as broken.
        """
        kind = type(self)
        is_here = kind.__module__.partition(".")[0] == __name__.partition(".")[0]
        name = kind.__name__ if is_here else f"{kind.__module__}.{kind.__name__}"
        settings = chain.from_iterable(vars(k).get("fact_settings", ()) for k in kind.__mro__[::-1])
        classes = getattr(self, "classes", None) or self.num_classes
        of_classes = {"classes": str(classes)} if self.class_names else {}
        of_settings = {setting: _fact(getattr(self, setting)) for setting in settings}
        images = {"images": self._test_images} if self._test_images else {}
        return {"data": name, **of_classes, **of_settings, **images}

    @property
    def label_names(self) -> tuple[str, ...]:
        """Names of the labels that `check` counts."""
        return self.class_names or ("unknown", "distance")

    @property
    def num_classes(self) -> int:
        """Number of classes K, which is the number of scores of a network."""
        return len(self.class_names) - (self.labels == PIXEL_CLASSES)

    def class_weights(self, kind: ClassWeights) -> Tensor:
        """Return weights of the classes in the loss, from the labels of the training split.

        Print a warning if labels seem to belong to other classes.

        Args:
            kind: Kind of weighting, see `class_weights.class_weights`.
        """
        counts = np.zeros(len(self.class_names), np.int64)
        if kind != "none":
            dataset = self.dataset("train")
            for labels in in_threads(dataset.labels, range(len(dataset))):
                counts += np.bincount(labels.ravel(), minlength=len(counts))
            for doubt in label_doubts("train", counts, self.class_names):
                print_on_rank_zero(f"Warning: {doubt}")
        return class_weights(counts[1:], kind)

    # --- loaders -------------------------------------------------------------------------------

    def train_dataloader(self) -> DataLoader[Any]:
        """Return the training batches; with ``overfit_batches``, the same views in every epoch."""
        dataset = self.dataset("train")
        if getattr(self.trainer, "overfit_batches", 0):
            share: Any = share_of_process(dataset)
            return self._loader(share, self.batch_size, ResumedOrder(share, self._start[1]))
        rank, world_size = this_process()
        count = len(dataset)
        if left_out := count % world_size:
            rank_zero_warn(
                f"{left_out} of {count} training {self.noun}, different ones each time, are left "
                f"out of each epoch: {world_size} processes take equally many.",
                category=UserWarning,
            )
        seed = self.seed, self.sampling_seed
        sampler = EpochSampler(count, seed, rank, world_size, self._start)
        return self._loader(dataset, self.batch_size, sampler)

    def val_dataloader(self) -> DataLoader[Any] | list[DataLoader[Any]]:
        """Return the validation batches; no loader without a validation split."""
        return self._evaluation_loader("val") if self.splits()["val"] else []

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
        sizes = {"batch_size": self.batch_size, "processes": trainer.world_size}
        return {"epoch": epoch, "batches": batches, **sizes}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        """Make the next training loader continue at this position, with the same order and views.

        Raises:
            SettingError: Another number of processes or batch size divides the epoch differently.
        """
        processes = 1 if self.trainer is None else self.trainer.world_size
        now = processes, self.batch_size
        before = state_dict["processes"], state_dict["batch_size"]
        if state_dict["batches"] and now != before:
            raise SettingError(
                "trainer.devices and data.batch_size",
                found=f"{now[0]} processes of {now[1]} {self.noun}",
                expected=f"{before[0]} of {before[1]}, as in the interrupted run",
                remedy="Within an epoch, resume as the run was started.",
            )
        self._start = state_dict["epoch"], state_dict["batches"] * self.batch_size


def _try_read(
    data: DataModule, is_checked: bool, item: tuple[Split, Any]
) -> tuple[tuple[Split, Any], Exception | None, Any]:
    """Read an item; return its error, or its counts of labels and a warning."""
    try:
        if is_checked:
            found = data.read(item[1])
            return item, None, (data.count_labels(found), data.warning(item[1], found))
        data.read_cached(item[1])
    except (DataError, SettingError, OSError) as error:
        return item, error, None
    return item, None, None


def _fact(value: Any) -> str:
    """Return a setting as text: a path without its folder, a whole number without a point."""
    if isinstance(value, list | tuple):
        return ", ".join(map(_fact, value))
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else Path(str(value)).name


@rank_zero_only
def print_on_rank_zero(text: str) -> None:
    """Print text unchanged, only in the first process."""
    print_text(text)
