"""Which frames of SYNTHIA's sequences are for training, validation and test."""

from __future__ import annotations

import math
from itertools import chain
from typing import TYPE_CHECKING

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from datamodules.core.found import Split
    from datamodules.core.reading import ImageFiles

__all__ = ["FRAMES", "SEQUENCES", "TEST", "TRAIN", "checked_sequences", "choose_frames", "divide"]

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


def checked_sequences(
    train: Sequence[str], test: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the sequences for training and for the test; numbers are made such names.

    Raises:
        SettingError: There are none of a kind, or some are for both.
    """
    # YAML reads 01 as a number.
    names = tuple(tuple(str(sequence).zfill(2) for sequence in some) for some in (train, test))
    for kind, some, others in (("train", names[0], ()), ("test", names[1], names[0])):
        if not some or not set(some) <= set(SEQUENCES) - set(others):
            raise SettingError(
                f"data.{kind}_sequences",
                found=list(some),
                expected=f"some of {', '.join(SEQUENCES)}, none for both training and test",
            )
    return names[0], names[1]


def divide(
    frames: Mapping[str, Sequence[Sequence[ImageFiles]]],
    test: Sequence[str],
    validation_fraction: float,
) -> dict[Split, list[ImageFiles]]:
    """What belongs to which split.

    Frames of a sequence are nearly the same as their neighbours, so validation takes those at the
    end of each training sequence, not some here and there.

    Args:
        frames: Of every sequence, in order: the images of each frame.
        test: Sequences for the test; all others are for training.
        validation_fraction: Share of each training sequence for validation: at least one frame,
            never all; 0 for no validation.

    Raises:
        DataError: A training sequence has a single frame, and validation wants some.
    """
    splits: dict[Split, list[ImageFiles]] = {"train": [], "val": [], "test": []}
    for sequence, found in frames.items():
        count = len(found)
        if sequence in test:
            splits["test"] += chain.from_iterable(found)
            continue
        if validation_fraction and count == 1:
            raise DataError(
                f"SYNTHIA sequence {sequence}",
                found="one frame",
                expected="two or more, to keep some for validation",
                remedy="Set data.validation_fraction=0, or use more frames.",
            )
        held = min(max(1, round(validation_fraction * count)), count - 1)
        last = count - held if validation_fraction else count
        splits["train"] += chain.from_iterable(found[:last])
        splits["val"] += chain.from_iterable(found[last:])
    return splits
