"""Training, validation and test splits of SYNTHIA's sequences."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, ClassVar

from datamodules.core.image_module import ImageDataModule
from datamodules.core.inputs import Input
from datamodules.core.reading import ImageFiles
from datamodules.synthia.reader import CLASSES, NORMALIZATIONS, Formats, SynthiaReader
from tangent_train.errors import SettingError

if TYPE_CHECKING:
    from datamodules.core.found import Split
    from datamodules.core.problems import Problems

__all__ = [
    "FRAMES",
    "SEQUENCES",
    "TEST",
    "TRAIN",
    "SynthiaSequences",
    "choose_frames",
    "divide",
]

SEQUENCES: tuple[str, ...] = ("01", "02", "04", "05", "06")
"""The sequences there are; OmniSYNTHIA has their summers."""

TRAIN: tuple[str, ...] = ("01", "02", "05", "06")
TEST: tuple[str, ...] = ("04",)
"""The split of Zhang et al. 2019."""

FRAMES = 500
"""About as many frames of each sequence became panoramas of OmniSYNTHIA."""


def choose_frames(frames: Sequence[str], count: int = FRAMES) -> list[str]:
    """The frames that become panoramas: all, or every n-th from the first, about `count`.

    As OmniSYNTHIA's authors chose them (Zhang et al. 2019): n is the number of frames divided by
    `count`, rounded, halves up.

    Raises:
        SettingError: `count` is less than 1.

    >>> len(choose_frames([str(i) for i in range(1250)]))
    417
    """
    if count < 1:
        raise SettingError("data.frames", found=count, expected="1 or more")
    step = math.floor(len(frames) / count + 0.5) if len(frames) > count else 1
    return list(frames[::step])


@dataclass(kw_only=True, eq=False, repr=False)
class SynthiaSequences(ImageDataModule):
    """The training and test sequences of OmniSYNTHIA's authors.

    Validation takes the last frames of each training sequence. Depth is clipped to 4 m, which is
    short for streets.

    Args:
        train_sequences: As ``01``.
        test_sequences: As ``04``.
        frames: Approximate number of frames per sequence, see `choose_frames`.

    Attributes:
        formats: Of the files.

    Raises:
        SettingError: A setting is invalid.
    """

    class_names = ("unknown", *CLASSES)
    normalizations = NORMALIZATIONS
    formats: ClassVar[Formats]

    inputs: Sequence[Input] = ("rgb",)
    train_sequences: Sequence[str] = TRAIN
    test_sequences: Sequence[str] = TEST
    frames: int = FRAMES

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, others in (("train_sequences", ()), ("test_sequences", self.train_sequences)):
            # YAML reads 01 as a number.
            some = tuple(str(sequence).zfill(2) for sequence in getattr(self, name))
            setattr(self, name, some)
            fine = some and set(some) <= set(SEQUENCES) - {str(o).zfill(2) for o in others}
            expected = f"some of {', '.join(SEQUENCES)}, none for both training and test"
            self.require(name, bool(fine), expected)

    @property
    def sequences(self) -> tuple[str, ...]:
        """Those of training, then those of the test."""
        return (*self.train_sequences, *self.test_sequences)

    @abstractmethod
    def list_images(self, sequence: str, *, with_depth: bool) -> list[list[ImageFiles]]:
        """The images of every frame of a sequence.

        Raises:
            DataError: There are none.
        """

    def find_images(
        self, problems: Problems
    ) -> tuple[SynthiaReader, dict[Split, list[ImageFiles]]]:
        """See `ImageDataModule`."""
        found: dict[str, list[list[ImageFiles]]] = {}
        for sequence in self.sequences:
            found[sequence] = []
            with problems.noted():
                with_depth = "depth" in self.inputs
                found[sequence] = self.list_images(sequence, with_depth=with_depth)
        splits = divide(found, self.test_sequences, self.validation_fraction)
        return SynthiaReader(self.formats), splits


def divide(
    frames: Mapping[str, Sequence[Sequence[ImageFiles]]],
    test: Sequence[str],
    validation_fraction: float,
) -> dict[Split, list[ImageFiles]]:
    """Assign frames to splits.

    Neighbouring frames are nearly identical, so validation takes those at the end of each training
    sequence.

    Args:
        frames: Of every sequence, in order: the images of each frame.
        test: Sequences for the test; all others are for training.
        validation_fraction: Share of each training sequence for validation: at least one frame,
            never all, so none of a single one; 0 for no validation.
    """
    splits: dict[Split, list[ImageFiles]] = {"train": [], "val": [], "test": []}
    for sequence, found in frames.items():
        count = len(found)
        if sequence in test:
            splits["test"] += chain.from_iterable(found)
            continue
        held = min(max(1, round(validation_fraction * count)), count - 1)
        last = count - held if validation_fraction else count
        splits["train"] += chain.from_iterable(found[:last])
        splits["val"] += chain.from_iterable(found[last:])
    return splits
