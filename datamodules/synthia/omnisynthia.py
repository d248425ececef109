"""OmniSYNTHIA (Zhang et al. 2019): panoramas of virtual streets, from SYNTHIA (Ros et al. 2016).

Features: 2096×4192 RGB, depth and 13 semantic classes (`reader.CLASSES`). The panoramas show what
four cameras saw: a band around the horizon, black and unknown above and below. Where there are none
yet, they are made from the four views of SYNTHIA's sequences 01, 02, 04, 05 and 06 SUMMER. `files`
has the tree on disk.

Licence: SYNTHIA is free for research: http://synthia-dataset.net.

Citation: G. Ros, L. Sellart, J. Materzynska, D. Vazquez, A. M. Lopez: "The SYNTHIA Dataset",
CVPR 2016. C. Zhang, S. Liwicki, W. Smith, R. Cipolla: "Orientation-aware Semantic Segmentation on
Icosahedron Spheres", ICCV 2019.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from datamodules.core.panorama_module import PanoramaDataModule
from datamodules.core.problems import Problems
from datamodules.core.samples import Input
from datamodules.synthia.files import GET_IT, list_panoramas, panorama_files, sequence_folder
from datamodules.synthia.generate import HEIGHT, make_panoramas
from datamodules.synthia.reader import (
    CLASSES,
    NORMALIZATIONS,
    PANORAMA_FORMATS,
    SynthiaReader,
)
from datamodules.synthia.splits import FRAMES, TEST, TRAIN, checked_sequences, divide
from tangent_train.errors import DataError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from datamodules.core.found import Split
    from datamodules.core.reading import ImageFiles

__all__ = ["OmniSynthia"]


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class OmniSynthia(PanoramaDataModule):
    """OmniSYNTHIA, 13 classes, with the training and test sequences of its authors.

    `root` holds ``SYNTHIA-SEQS-01-SUMMER`` …, each with the four views or with panoramas. Depth is
    clipped to 4 m, which is little in a street; the published panoramas have the z-depth of the
    views instead of distance. Validation takes the last panoramas of each training sequence.

    Args:
        train_sequences: As ``01``.
        test_sequences: As ``04``.
        frames: About how many panoramas of each sequence to make, see `choose_frames`.
        panorama_height: Rows of those that are made.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names = ("unknown", *CLASSES)
    normalizations = NORMALIZATIONS

    inputs: Sequence[Input] = ("rgb",)
    train_sequences: Sequence[str] = TRAIN
    test_sequences: Sequence[str] = TEST
    frames: int = FRAMES
    panorama_height: int = HEIGHT

    def __post_init__(self) -> None:
        super().__post_init__()
        chosen = checked_sequences(self.train_sequences, self.test_sequences)
        self.train_sequences, self.test_sequences = chosen
        self._not_made = Problems()

    def make_files(self) -> None:
        """Make the panoramas of sequences that have none yet, or are not finished.

        Raises:
            DataError: There is nothing to make them from, or it is broken.
        """
        self._not_made = Problems()
        sequences = (*self.train_sequences, *self.test_sequences)
        make_panoramas(
            self.root, sequences, self._not_made, frames=self.frames, height=self.panorama_height
        )
        if not self.skip_broken:
            self._not_made.refuse(self.root, "data.skip_broken=true leaves out these frames.")

    def find_images(
        self, problems: Problems
    ) -> tuple[SynthiaReader, dict[Split, list[ImageFiles]]]:
        """See `PanoramaDataModule`."""
        problems.add_all(self._not_made)
        sequences = (*self.train_sequences, *self.test_sequences)
        found = {sequence: self._panoramas(sequence, problems) for sequence in sequences}
        splits = divide(found, self.test_sequences, self.validation_fraction)
        return SynthiaReader(PANORAMA_FORMATS), splits

    def _panoramas(self, sequence: str, problems: Problems) -> list[list[ImageFiles]]:
        folder = sequence_folder(self.root, sequence)
        frames: list[str] = []
        with problems.noted():
            frames = list_panoramas(folder)
            if not frames:
                raise DataError(
                    folder / "pano" / "RGB",
                    found="no panoramas",
                    expected="000000.png and others",
                    remedy=f"Run tangent-prepare to make them from the views. {GET_IT}",
                )
        with_depth = "depth" in self.inputs
        return [
            [panorama_files(self.root, sequence, frame, with_depth=with_depth)] for frame in frames
        ]
