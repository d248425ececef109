"""Which frames of SYNTHIA's sequences are for training, validation and test."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

from tangent_train.errors import DataError, SettingError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from datamodules.core.segmentation_module import Split

__all__ = ["FRAMES", "SEQUENCES", "TEST", "TRAIN", "SequenceSplits", "choose_frames"]

SEQUENCES: tuple[str, ...] = ("01", "02", "04", "05", "06")
"""The sequences there are; OmniSYNTHIA has their summers."""

TRAIN: tuple[str, ...] = ("01", "02", "05", "06")
TEST: tuple[str, ...] = ("04",)
"""The split of Zhang et al. 2019."""

FRAMES = 500
"""About as many frames of each sequence became panoramas of OmniSYNTHIA."""

_Item = TypeVar("_Item")


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


@dataclass(frozen=True)
class SequenceSplits:
    """Sequences for training and test, and what validation takes from the former.

    Frames of a sequence are nearly the same as their neighbours, so validation takes those at the
    end of each training sequence, not some here and there.

    Attributes:
        train: Sequences, as ``01``; numbers are made such names.
        test: Likewise.
        validation_fraction: Share of each training sequence for validation: at least one frame,
            never all; 0 for no validation.

    Raises:
        SettingError: A setting that cannot work.
    """

    train: tuple[str, ...]
    test: tuple[str, ...]
    validation_fraction: float

    def __post_init__(self) -> None:
        for name in ("train", "test"):
            # YAML reads 01 as a number.
            sequences = tuple(str(sequence).zfill(2) for sequence in getattr(self, name))
            object.__setattr__(self, name, sequences)
            others = set(self.train) if name == "test" else set()
            if not sequences or not set(sequences) <= set(SEQUENCES) - others:
                raise SettingError(
                    f"data.{name}_sequences",
                    found=list(sequences),
                    expected=f"some of {', '.join(SEQUENCES)}, none for both training and test",
                )
        if not 0 <= self.validation_fraction < 1:
            raise SettingError(
                "data.validation_fraction",
                found=self.validation_fraction,
                expected="0 to below 1",
            )

    @property
    def sequences(self) -> tuple[str, ...]:
        """All of them."""
        return self.train + self.test

    def divide(self, items_of: Callable[[str], Sequence[_Item]]) -> dict[Split, list[_Item]]:
        """What belongs to which split.

        Args:
            items_of: What a sequence holds, one item per frame, in order.

        Raises:
            DataError: A training sequence has a single frame, and validation wants some.
        """
        splits: dict[Split, list[_Item]] = {"train": [], "val": [], "test": []}
        for sequence in self.train:
            items = items_of(sequence)
            held = self._held_out(sequence, len(items))
            splits["train"] += items[: len(items) - held]
            splits["val"] += items[len(items) - held :]
        for sequence in self.test:
            splits["test"] += items_of(sequence)
        return splits

    def _held_out(self, sequence: str, count: int) -> int:
        if self.validation_fraction == 0:
            return 0
        if count == 1:
            raise DataError(
                f"SYNTHIA sequence {sequence}",
                found="one frame",
                expected="two or more, to keep some for validation",
                remedy="Set data.validation_fraction=0, or use more frames.",
            )
        return min(max(1, round(self.validation_fraction * count)), count - 1)
