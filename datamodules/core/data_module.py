"""Base of all data sets: settings, files, checks, loaders, resuming."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import field
from functools import cached_property, partial, wraps
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar, dataclass_transform

import cv2
import numpy as np
import torch
from lightning import LightningDataModule
from lightning.pytorch.trainer.states import TrainerFn
from lightning.pytorch.utilities import rank_zero_only
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, NonNegativeInt, PositiveInt, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from datamodules.core.cache import Cache
from datamodules.core.dataset import SplitDataset
from datamodules.core.files import SPLITS, Problems, Split, draw_groups
from datamodules.core.label_map import (
    PANOPTIC,
    PIXEL_CLASSES,
    ClassWeights,
    class_weights,
    label_doubts,
)
from datamodules.core.loading import EpochSampler, share_of_process, this_process
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError, wrong_setting
from tangent_train.progress import show_progress
from tangent_train.rendering import TangentRepresentation
from tangent_train.threads import in_threads

_Class = TypeVar("_Class", bound=type[Any])

_REMEDY = (
    "tangent-check with the same data settings lists all problems; data.skip_broken=true leaves "
    "broken files out."
)

print_on_rank_zero = rank_zero_only(print_text)
"""Print text unchanged, only in the first process."""


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
            cause = error.errors()[0].get("ctx", {}).get("error")
            if not isinstance(cause, DataError | SettingError):
                known = dict.fromkeys(made.__dataclass_fields__, "a value")
                cause = wrong_setting(error, known, "data.")
            raise cause from error

    made.__init__ = checked
    return made


@data_set
class DataModule(LightningDataModule, ABC):
    """A data set split for training, validation and test, with loaders for a trainer.

    Its fields are the settings `data.*` of a config. It lists the files of its splits (`files`)
    and reads them (`read`). Create the trainer with ``use_distributed_sampler=False``, see
    `EpochSampler`.

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
        labels: Kind of labels, see `datamodules.core.label_map`.
        noun: Name of the images or shapes, in the plural.
        kind: Named tuple of the arrays of an image or shape.
        samples: Class of the samples of a split.
        default_representation: Function that returns the representation of a level.
        default_level: Its level without a setting.
        suitable: Attribute that a representation must have, and the name of one that has it.
        get_it: Where to get the data set, for messages.
        class_names: Name of every label; for pixel labels the first is unknown, not a class. Empty
            if the labels are distances.
        fact_settings: Settings of the class that scores on the test split depend on, see `facts`.
        cache_settings: Attributes of the class that `read` depends on besides the files.
        test_split: Published split of the test images. With `val`, validation uses scenes of the
            training images, named ``<scene>/…``: nothing is selected on the test images.
        folds: Values of the setting ``fold``, over which published evaluations average.
        problems: Problems of the files, found so far.
        label_counts: After `check`, pixels of each of the `label_names` in the files, by split.

    Raises:
        SettingError: A setting is invalid.
    """

    noun: ClassVar[str]
    kind: ClassVar[type[Any]]
    samples: ClassVar[type[SplitDataset]]
    suitable: ClassVar[tuple[str, str]] = ("erp_height", "tangent")
    default_representation: ClassVar[Any] = staticmethod(partial(TangentRepresentation, 0))
    default_level: ClassVar[int] = 7
    get_it: ClassVar[str] = ""
    labels: ClassVar[str] = PIXEL_CLASSES
    class_names: ClassVar[tuple[str, ...]] = ()
    fact_settings: ClassVar[tuple[str, ...]] = ()
    cache_settings: ClassVar[tuple[str, ...]] = ()
    test_split: ClassVar[Literal["test", "val"]] = "test"
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
        is_given = self.representation is not None
        self.refuse("level", is_given and self.level is not None, "null: the representation has it")
        if not is_given:
            level = self.default_level if self.level is None else self.level
            self.representation = self.default_representation(level)
        if not hasattr(self.representation, self.suitable[0]):
            raise SettingError(
                "representation",
                found=type(self.representation).__name__,
                expected=f"one for {self.noun}, such as representation={self.suitable[1]}",
            )
        self.problems = Problems()
        self.label_counts: dict[Split, NDArray[np.int64]] = {}
        self._splits: dict[Split, list[Any]] | None = None
        self._datasets: dict[Split, Any] = {}
        self._test_images = ""
        self._start = (0, 0)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "trainer": None, "_datasets": {}}

    def refuse(self, setting: str, is_wrong: object, expected: str) -> None:
        """Refuse the value of a setting that is wrong for this data set or beside other settings.

        Raises:
            SettingError: It is wrong.
        """
        if is_wrong:
            found = getattr(self, setting)
            found = list(found) if isinstance(found, tuple) else found
            raise SettingError(f"data.{setting}", found=found, expected=expected)

    # --- defined by subclasses ---------------------------------------------------------------

    @abstractmethod
    def files(self) -> Mapping[Split, Sequence[Any]]:
        """Return the files of every image or shape, not yet opened, by split.

        Files of an item have a unique `name` and `paths`. Broken files are included, so that splits
        do not depend on them. Warnings and problems of the folders are added to `problems`.

        Raises:
            DataError: The data set as a whole cannot be used.
        """

    @abstractmethod
    def read(self, files: Any) -> Any:
        """Read one image or shape as a named tuple of arrays, which the cache keeps.

        Raises:
            DataError: A file is broken.
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
        return item

    def check_files(self, files: Any) -> None:
        """Check, without decoding, that the files of an image or shape fit the settings.

        Raises:
            DataError: A file does not fit.
            SettingError: A setting does not suit the files.
        """

    def groups(self, files: Any) -> Sequence[str]:
        """Return the groups of an image that get rows in the results, such as its weather."""
        return ()

    def make_files(self) -> None:
        """Generate the files of a synthetic data set."""

    def evaluation_size(self) -> int:
        """Number of samples in a batch of validation and test."""
        return 1

    def in_parallel(self, work: Callable[[Any], Any], items: Sequence[Any]) -> Generator[Any]:
        """Yield results of a function for all items as they come."""
        return in_threads(work, items)

    def inspect(self, files: Any, item: Any) -> tuple[NDArray[np.int64] | None, str]:
        """Return the pixels of each label name, None for shapes, and perhaps a warning."""
        return None, ""

    # --- finding, checking and reading ---------------------------------------------------------

    def splits(self) -> dict[Split, list[Any]]:
        """Return the usable files of each split; the first call finds and checks them.

        Raises:
            DataError: Something is broken; the message names all problems.
            SettingError: A setting does not suit the data.
        """
        if self._splits is None:
            found = self._find_files()
            for warning in self.problems.warnings:
                print_on_rank_zero(f"Warning: {warning}")
            if self.skip_broken and not self.problems.fatal:
                self._read_all(found, "Checking the data")
                usable = self._usable(found)
                if broken := self.problems.items:
                    print_on_rank_zero(
                        f"{len(broken)} {self.noun} are broken and left out "
                        "(data.skip_broken=true); tangent-check lists them."
                    )
                if len(usable["test"]) < len(found["test"]):
                    self._test_images = f"{len(usable['test'])} of {len(found['test'])}"
                found, self.problems = usable, Problems()
            self.problems.refuse(self.root, _REMEDY)
            self._splits = found
        return self._splits

    def dataset(self, split: Split) -> Any:
        """Return the samples of a split; with `in_memory`, read everything now."""
        if split not in self._datasets:
            self._datasets[split] = self.samples(self, split)
        return self._datasets[split]

    def check(self) -> tuple[Problems, int]:
        """Read the whole data set and count its labels; generate and write nothing.

        Returns:
            All problems, and the number of images or shapes, broken ones included.
        """
        found = self._find_files()
        size = len(self.label_names)
        self.label_counts = {split: np.zeros(size, np.int64) for split in SPLITS}
        self._read_all(found, "Checking", is_check=True)
        names = {files.name for files in chain.from_iterable(found.values())}
        return self.problems, len(names | self.problems.items)

    def _find_files(self) -> dict[Split, list[Any]]:
        """Return the files of all splits; note problems of files and of the whole data set."""
        self.problems = Problems()
        found: dict[Split, list[Any]] = {split: [] for split in SPLITS}
        with self.problems.noted():
            listed = self.files() if self.root.is_dir() else {}
            found |= {split: list(files) for split, files in listed.items()}
            if not any(found.values()) and not self.problems.items:
                raise DataError(
                    self.root,
                    found=f"no {self.noun}" if self.root.is_dir() else "no such folder",
                    expected=f"{self.noun}, as docs and the docstring of the data set describe",
                    remedy=f"Name its folder in data.root. {self.get_it}".rstrip(),
                )
        self._test_images = self.problems.incomplete.get(self.test_split, "")
        if self.test_split == "val":
            scenes = {files.name: files.name.partition("/")[0] for files in found["train"]}
            drawn = draw_groups(scenes.values(), self.val_fraction, self.seed)
            found["test"] = found["val"]
            found["val"] = [files for files in found["train"] if scenes[files.name] in drawn]
            found["train"] = [files for files in found["train"] if scenes[files.name] not in drawn]
        elif not self.val_fraction:
            found["val"] = []

        def check(files: Any) -> None:
            with self.problems.noted(files.name):
                self.check_files(files)

        list(in_threads(check, chain.from_iterable(self._usable(found).values())))
        return found

    def _usable(self, found: Mapping[Split, Sequence[Any]]) -> dict[Split, list[Any]]:
        return {split: self.problems.without(files) for split, files in found.items()}

    def _read_all(
        self, found: Mapping[Split, Sequence[Any]], description: str, *, is_check: bool = False
    ) -> None:
        """Read all items once, into the cache if there is one; note broken files."""
        items = [(split, files) for split in found for files in self.problems.without(found[split])]

        def noted() -> Iterator[None]:
            with closing(self.in_parallel(partial(_try_read, self, is_check), items)) as results:
                for split, problems, counts in results:
                    self.problems.add_all(problems)
                    if counts is not None:
                        self.label_counts[split] += counts
                    yield

        show_progress(noted(), description, self.noun, len(items))

    def read_cached(self, files: Any) -> Any:
        """Read one image or shape from the cache, or from its files."""
        if self.cache is None:
            return self.read(files)
        return self._cache.read(files, partial(self.read, files))

    @cached_property
    def _cache(self) -> Cache:
        folder: Any = self.cache
        settings = {name: repr(getattr(self, name)) for name in self._declared("cache_settings")}
        return Cache(folder, {"data": type(self).__name__, **settings}, self.kind)

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
            path = self._cache.path
            missing = {s: [f for f in of if not path(f).is_file()] for s, of in splits.items()}
            self._read_all(missing, f"Preparing {self.noun}")
            self.problems.refuse(self.root, _REMEDY)

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
        classes = getattr(self, "classes", None) or self.num_classes
        of_classes = {"classes": str(classes)} if self.class_names else {}
        of_settings = {
            setting: _fact(getattr(self, setting)) for setting in self._declared("fact_settings")
        }
        images = {"images": self._test_images} if self._test_images else {}
        return {"data": name, **of_classes, **of_settings, **images}

    def _declared(self, attribute: str) -> list[str]:
        """Return the names that the class and its bases list in an attribute."""
        return [name for kind in type(self).__mro__[::-1] for name in vars(kind).get(attribute, ())]

    @property
    def label_names(self) -> tuple[str, ...]:
        """Names of the labels that `check` counts."""
        return self.class_names or ("unknown", "distance")

    @property
    def num_classes(self) -> int:
        """Number of classes K, which is the number of scores of a network."""
        return len(self.class_names) - (self.labels in (PIXEL_CLASSES, PANOPTIC))

    def class_weights(self, kind: ClassWeights) -> Tensor:
        """Return weights of the classes in the loss, from the labels of the training split.

        Print a warning if labels seem to belong to other classes.

        Args:
            kind: Kind of weighting, see `label_map.class_weights`.
        """
        counts = np.zeros(len(self.class_names), np.int64)
        if kind != "none":
            dataset = self.dataset("train")
            for labels in in_threads(dataset.labels, range(len(dataset))):
                counts += np.bincount(labels.ravel(), minlength=len(counts))
            for doubt in label_doubts("train", counts, self.class_names):
                print_on_rank_zero(f"Warning: {doubt}")
        return torch.from_numpy(class_weights(counts[1:], kind))

    # --- loaders -------------------------------------------------------------------------------

    def train_dataloader(self) -> DataLoader[Any]:
        """Return the training batches; with ``overfit_batches``, the same views in every epoch."""
        dataset, seed = self.dataset("train"), (self.seed, self.sampling_seed)
        is_fixed = bool(getattr(self.trainer, "overfit_batches", 0))
        order = (*this_process(), self._start)
        sampler = EpochSampler(len(dataset), seed, *order, is_fixed=is_fixed)
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
        return DataLoader(
            dataset,
            batch_size=batch_size,
            sampler=sampler,
            # Its own generator: it draws seeds for its workers, which would shift dropout's.
            generator=torch.Generator().manual_seed(self.seed),
            num_workers=self.num_workers,
            persistent_workers=self.num_workers > 0,
            pin_memory=torch.cuda.is_available(),
            worker_init_fn=_opencv_without_threads,
        )

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
    data: DataModule, is_check: bool, item: tuple[Split, Any]
) -> tuple[Split, Problems, NDArray[np.int64] | None]:
    """Read an item; return its problems, and for a check the counts of its labels."""
    (split, files), problems = item, Problems()
    with problems.noted(files.name, files.paths[0]):
        if is_check:
            counts, warning = data.inspect(files, data.read(files))
            problems.warnings += [warning] if warning else []
            return split, problems, counts
        data.read_cached(files)
    return split, problems, None


def _fact(value: Any) -> str:
    """Return a setting as text: a path without its folder, a whole number without a point."""
    if isinstance(value, list | tuple):
        return ", ".join(map(_fact, value))
    if value is None:
        return "none"
    return f"{value:g}" if isinstance(value, float) else Path(str(value)).name


def _opencv_without_threads(_worker: int) -> None:
    # The workers are the parallelism; threads inside them would only fight over the cores. Not 1:
    # that waits for threads which the parent had and the forked worker does not.
    cv2.setNumThreads(0)
