"""SYNTHIA's views as photos (Ros et al. 2016): those that OmniSYNTHIA's panoramas are made of.

`files` has the tree on disk, `omnisynthia` licence and citation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from datamodules.core.photo_module import PhotoDataModule
from datamodules.core.samples import Input
from datamodules.synthia.files import (
    GET_IT,
    VIEWS,
    list_frames,
    sequence_folder,
    view_files,
    views_folder,
)
from datamodules.synthia.reader import CLASSES, NORMALIZATIONS, VIEW_FORMATS, SynthiaReader
from datamodules.synthia.splits import (
    FRAMES,
    TEST,
    TRAIN,
    checked_sequences,
    choose_frames,
    divide,
)
from tangent_train.errors import DataError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from datamodules.core.found import Split
    from datamodules.core.problems import Problems
    from datamodules.core.reading import ImageFiles

__all__ = ["SynthiaPerspective"]


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class SynthiaPerspective(PhotoDataModule):
    """SYNTHIA's views, 13 classes, of the frames and in the splits of OmniSYNTHIA.

    Depth is clipped to 4 m, which is little in a street.

    Args:
        train_sequences: As ``01``.
        test_sequences: As ``04``.
        frames: About how many frames of each sequence to use, see `choose_frames`.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names = ("unknown", *CLASSES)
    normalizations = NORMALIZATIONS

    inputs: Sequence[Input] = ("rgb",)
    train_sequences: Sequence[str] = TRAIN
    test_sequences: Sequence[str] = TEST
    frames: int = FRAMES

    def __post_init__(self) -> None:
        super().__post_init__()
        chosen = checked_sequences(self.train_sequences, self.test_sequences)
        self.train_sequences, self.test_sequences = chosen

    def find_images(
        self, problems: Problems
    ) -> tuple[SynthiaReader, dict[Split, list[ImageFiles]]]:
        """See `PhotoDataModule`."""
        sequences = (*self.train_sequences, *self.test_sequences)
        found = {sequence: self._views(sequence, problems) for sequence in sequences}
        splits = divide(found, self.test_sequences, self.validation_fraction)
        return SynthiaReader(VIEW_FORMATS), splits

    def _views(self, sequence: str, problems: Problems) -> list[list[ImageFiles]]:
        """The views of the chosen frames of a sequence."""
        folder = sequence_folder(self.root, sequence)
        frames: list[str] = []
        with problems.noted():
            frames = choose_frames(list_frames(folder), self.frames)
            if not frames:
                raise DataError(
                    views_folder(folder, VIEWS[0]),
                    found="no views",
                    expected="000000.png and others",
                    remedy=GET_IT,
                )
        with_depth = "depth" in self.inputs
        return [
            [view_files(self.root, sequence, frame, v, with_depth=with_depth) for v in VIEWS]
            for frame in frames
        ]
