"""Base of all data sets: settings, index, checks, and the PyTorch data set of each split."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from lightning.pytorch.utilities import rank_zero_only
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from datamodules.core.class_weights import ClassWeights, class_weights, label_doubts
from datamodules.core.index import SPLITS, DatasetIndex, Item, Split
from datamodules.core.inputs import Normalization
from datamodules.core.labels import DISTANCE, PIXEL_CLASSES
from datamodules.core.problems import Problems
from datamodules.core.reading import SplitReader, Transform
from tangent_train.console import print_text
from tangent_train.errors import DataError, SettingError
from tangent_train.files import is_class_name
from tangent_train.threads import in_threads

_Item = TypeVar("_Item", bound=Item)

REMEDY = (
    "tangent-check with the same data settings lists all problems; data.skip_broken=true leaves "
    "broken files out."
)
"""Remedy for broken items."""


@dataclass(kw_only=True, eq=False, repr=False)
class LabeledData(ABC, Generic[_Item]):
    """A data set split for training, validation and test.

    A data set is a dataclass: its fields are the settings `data.*` of a config. It defines the
    items of its splits (`find`) and their samples (`dataset`).

    Args:
        root: Folder of the data set.
        representation: Representation of the images; by default `default_representation`.
        level: Level of the default representation.
        val_fraction: Share of the training data that is held out for validation; 0 for no
            validation.
        normalization: See `Normalization.of`; by default that of the data.
        seed: Seed of the splits, the order, the views and the augmentation, 0 or more.
        sampling_seed: Further seed of the order, the views and the augmentation: with another
            number, fine-tuning does not repeat the views of the first training.
        store: Folder of a prepared store, see `store`: everything is decoded once, then read from
            there. The samples are the same without.
        in_memory: Keep decoded data in memory.
        skip_broken: Read all items first and leave out broken ones, instead of refusing the data.

    Attributes:
        class_names: Name of every label; for pixel labels the first is unknown, not a class. Empty
            if the labels are distances.
        fact_settings: Settings of the class that scores on the test split depend on, see `facts`.
        labels: Kind of labels of the items, see `datamodules.core.labels`.
        noun: Name of the items, in the plural.
        label_counts: After `check`, pixels of each of the `label_names` in the files, by split.

    Raises:
        SettingError: A setting is invalid.
    """

    labels: str = field(init=False, default=PIXEL_CLASSES)
    noun: ClassVar[str]

    root: Path = field(kw_only=False)
    representation: Any = field(kw_only=False, default=None)
    level: int | None = None
    val_fraction: float = 0.1
    normalization: Normalization | str | Mapping[str, Sequence[float]] | None = None
    seed: int = 0
    sampling_seed: int = 0
    store: Path | None = None
    in_memory: bool = False
    skip_broken: bool = False
    class_names: tuple[str, ...] = field(init=False)
    fact_settings: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        super().__init__()
        self.root = Path(self.root)
        self.store = None if self.store is None else Path(self.store)
        if self.representation is None:
            self.representation = self.default_representation()
        else:
            self.require("level", self.level is None, "null: the representation has a level")
        fine = 0 <= self.val_fraction < 1
        self.require("val_fraction", fine, "0 to below 1")
        for name in ("seed", "sampling_seed"):
            self.require(name, getattr(self, name) >= 0, "0 or more")
        self.label_counts: dict[Split, NDArray[np.int64]] = {}
        self._index: DatasetIndex[_Item] | None = None
        self._test_images = ""
        self._readers: dict[Split, SplitReader[_Item, Any]] = {}

    # --- defined by subclasses ---------------------------------------------------------------

    @abstractmethod
    def default_representation(self) -> Any:
        """Return the representation used without a setting for it, at `level`."""

    @abstractmethod
    def find(self, problems: Problems) -> DatasetIndex[_Item]:
        """Find the items of all splits and check them without decoding.

        Args:
            problems: Collects problems; the index also contains broken items.

        Raises:
            DataError: The data set as a whole cannot be used.
        """

    def transforms(self, split: Split) -> Sequence[Transform[Any, _Item]]:
        """Return the transforms of every item of a split, in order."""
        del split
        return ()

    @abstractmethod
    def dataset(self, split: Split) -> Dataset[Any]:
        """Return the samples of a split as a map-style data set of PyTorch.

        A sample of ``"train"`` holds randomly drawn views, a sample of ``"val"`` or ``"test"`` all
        views. A key is an index, or an epoch and an index: each epoch draws other views; an index
        alone means epoch 0.

        Args:
            split: Name of the split.
        """

    def groups(self, item: _Item) -> Sequence[str]:
        """Return the groups of an item that get rows in the results, such as its weather."""
        del item
        return ()

    @property
    @abstractmethod
    def in_channels(self) -> int:
        """Number of input channels."""

    @abstractmethod
    def normalized(self, batch: Any) -> Tensor:
        """Return the images of a batch, normalized for the network."""

    def make_files(self) -> None:
        """Generate the files of a synthetic data set."""

    # --- settings ------------------------------------------------------------------------------

    def require(self, setting: str, fine: bool, expected: str, remedy: str = "") -> None:
        """Refuse an invalid value of a setting ``data.<setting>``.

        Raises:
            SettingError: The value is invalid.
        """
        if not fine:
            found = getattr(self, setting)
            found = list(found) if isinstance(found, tuple) else found
            raise SettingError(f"data.{setting}", found=found, expected=expected, remedy=remedy)

    def require_one_of(self, setting: str, *options: str) -> None:
        """Refuse other values of a setting ``data.<setting>`` than these.

        Raises:
            SettingError: The value is invalid.
        """
        self.require(setting, getattr(self, setting) in options, " or ".join(options))

    def require_representation(self, attribute: str, choice: str) -> None:
        """Refuse a representation that is made for another kind of images.

        Args:
            attribute: Attribute that all suitable representations have.
            choice: Name of a suitable representation, for the error message.

        Raises:
            SettingError: The representation is not suitable.
        """
        if not hasattr(self.representation, attribute):
            found, expected = type(self.representation).__name__, f"one for {self.noun}"
            remedy = f"Choose representation={choice}, or other data."
            raise SettingError("representation", found=found, expected=expected, remedy=remedy)

    def check_classes(self) -> None:
        """Check the names of the classes: present, and without control characters.

        Raises:
            SettingError: A name is missing or invalid.
        """
        names = getattr(self, "class_names", ())
        setting = f"class_names of {type(self).__name__}"
        if self.labels == DISTANCE:
            return
        if not names or (self.labels == PIXEL_CLASSES and names[0] != "unknown"):
            raise SettingError(
                setting,
                found=f"{names[0]} first" if names else "none",
                expected="unknown, then the classes: label 0 is ignored",
            )
        for name in names:
            if not is_class_name(name):
                expected = "names without control characters and line ends"
                raise SettingError(setting, found=repr(name), expected=expected)

    # --- finding and checking ----------------------------------------------------------------

    def index(self) -> DatasetIndex[_Item]:
        """Return the index of the usable items; the first call finds and checks them.

        Raises:
            DataError: Something is broken; the message names all problems.
            SettingError: A setting does not suit the data.
        """
        if self._index is None:
            self._index = self._find_usable()
        return self._index

    def check(self) -> tuple[Problems, int]:
        """Read the whole data set and count its labels; generate and write nothing.

        Returns:
            All problems, and the number of images or shapes, broken ones included.
        """
        problems, count = Problems(), 0
        counts: dict[str, NDArray[np.int64]] = {}
        with problems.noted():
            index = self._find_all(problems)
            count = len(problems.items.union(item.name for item in index.of()))
            index.check(problems, counts)
            for split in SPLITS:
                of_split = [counts[i.name] for i in index.splits[split] if i.name in counts]
                none = np.zeros(len(self.label_names), np.int64)
                self.label_counts[split] = np.sum([none, *of_split], axis=0)
        return problems, count

    def prepare_part(self, part: Callable[[Sequence[_Item]], Sequence[_Item]]) -> int:
        """Complete a part of the store, e.g. on one of several machines.

        Args:
            part: Selects some of all items, which have the same order on every machine.

        Returns:
            Number of items of this part that are in the store.

        Raises:
            DataError: An item of the part is broken.
            SettingError: There is no store.
        """
        self.make_files()
        problems = Problems()
        index = self._find_checked(problems)
        if index.store is None:
            expected = "a folder: only a store can be prepared in parts"
            raise SettingError("data.store", found="none, with shard=", expected=expected)
        if not self.skip_broken:
            problems.refuse(self.root, REMEDY)
        items = part(index.of())
        index.read_all(items, problems, whole=True)
        if not self.skip_broken:
            problems.refuse(self.root, REMEDY)
        return len(problems.without(items))

    def _find_all(self, problems: Problems) -> DatasetIndex[_Item]:
        """Return the index of all items; refuse invalid class names and an empty data set."""
        self.check_classes()
        found = f"no {self.noun}" if self.root.is_dir() else "no such folder"
        try:
            index = self.find(problems)
        except DataError as error:
            if self.root.is_dir():
                raise
            raise DataError(
                self.root, found=found, expected=error.expected, remedy=error.remedy
            ) from error
        if not index.of() and not problems.items:
            expected = f"{self.noun}, as docs and the docstring of the data set describe them"
            raise DataError(self.root, found=found, expected=expected)
        return index

    def _find_checked(self, problems: Problems) -> DatasetIndex[_Item]:
        """Return the index of all items, including broken ones; refuse an unusable data set."""
        index: Any = None
        with problems.noted():
            index = self._find_all(problems)
        if problems.fatal:
            problems.refuse(self.root)
        return index

    def _find_usable(self, *, sample: bool = False, whole: bool = True) -> DatasetIndex[_Item]:
        """Return the index of usable items; refuse broken items unless `skip_broken`.

        Args:
            sample: True to decode some images.
            whole: True to check the content of the store too, where everything is read.
        """
        problems = Problems()
        index = self._find_checked(problems)
        self._test_images = problems.incomplete.get(getattr(self, "test_split", "test"), "")
        for warning in problems.warnings if self._index is None else ():  # once
            print_on_rank_zero(f"Warning: {warning}")
        if not self.skip_broken:
            if sample and self.store is None:
                index.read_some(self.seed, problems)
            problems.refuse(self.root, REMEDY)
            return index
        index.read_all(index.of(), problems, whole=whole)
        usable = index.without(problems)
        count, of = len(usable.splits["test"]), len(index.splits["test"])
        if count < of:
            self._test_images = f"{count} of {of}"
        for split in SPLITS:
            if index.splits[split] and not usable.splits[split]:
                raise DataError(
                    self.root,
                    found=f"no {self.noun} for {split} that can be used",
                    expected="one or more",
                    remedy="tangent-check lists their problems.",
                )
        if problems.items:
            total = len(problems.items.union(item.name for item in index.of()))
            print_on_rank_zero(
                f"{len(problems.items)} of {total} {self.noun} are broken and left out "
                "(data.skip_broken=true); tangent-check lists them."
            )
        return usable

    # --- reading -------------------------------------------------------------------------------

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

    def source(self, split: Split) -> SplitReader[_Item, Any]:
        """Return the source of a split; with `in_memory`, read everything now."""
        if split not in self._readers:
            if split not in self.index().splits:
                raise SettingError("split", found=split, expected=", ".join(self.index().splits))
            reader = SplitReader(self.index(), split, self.transforms(split))
            if self.in_memory:
                reader.keep_in_memory(self.root)
            self._readers[split] = reader
        return self._readers[split]

    def class_weights(self, kind: ClassWeights) -> Tensor:
        """Return weights of the classes in the loss, from the labels of the training split.

        Print a warning if labels seem to belong to other classes.

        Args:
            kind: Kind of weighting, see `class_weights.class_weights`.
        """
        counts = np.zeros(len(self.class_names), np.int64)
        if kind != "none":
            source = self.source("train")
            for labels in in_threads(source.labels, range(len(source))):
                counts += np.bincount(self.recorded(labels).ravel(), minlength=len(counts))
            for doubt in label_doubts("train", counts, self.class_names):
                print_on_rank_zero(f"Warning: {doubt}")
        return class_weights(counts[1:], kind)

    def recorded(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the labels of one training image that its file contains."""
        return labels


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
