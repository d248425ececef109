"""OmniSYNTHIA (Zhang et al. 2019): panoramas of virtual streets, from SYNTHIA (Ros et al. 2016).

Features: 2096×4192 RGB, depth and 13 semantic classes (`reader.CLASSES`). The panoramas combine
four cameras: a band around the horizon, black and unknown above and below. Missing panoramas are
generated from the four views of SYNTHIA's sequences 01, 02, 04, 05 and 06 SUMMER, which are
photos too. `files` has the tree on disk.

Licence: SYNTHIA is free for research: http://synthia-dataset.net.

Citation: G. Ros, L. Sellart, J. Materzynska, D. Vazquez, A. M. Lopez: "The SYNTHIA Dataset",
CVPR 2016. C. Zhang, S. Liwicki, W. Smith, R. Cipolla: "Orientation-aware Semantic Segmentation on
Icosahedron Spheres", ICCV 2019.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from datamodules.core.image_module import PanoramaDataModule, PhotoDataModule
from datamodules.core.problems import Problems
from datamodules.synthia.files import (
    GET_IT,
    VIEWS,
    list_frames,
    list_panoramas,
    panorama_files,
    sequence_folder,
    view_files,
    views_folder,
)
from datamodules.synthia.generate import HEIGHT, make_panoramas
from datamodules.synthia.reader import PANORAMA_FORMATS, VIEW_FORMATS
from datamodules.synthia.splits import SynthiaSequences, choose_frames
from tangent_train.errors import DataError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from datamodules.core.found import Found
    from datamodules.core.reading import ImageFiles

__all__ = ["OmniSynthia", "SynthiaPerspective"]


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class OmniSynthia(SynthiaSequences, PanoramaDataModule):
    """OmniSYNTHIA, 13 classes, with the training and test sequences of its authors.

    `root` holds ``SYNTHIA-SEQS-01-SUMMER`` …, each with the four views or with panoramas; missing
    panoramas are generated from `frames` frames. The published panoramas have the z-depth of
    the views instead of distance.

    Args:
        panorama_height: Rows of generated panoramas.

    Raises:
        SettingError: A setting is invalid.
    """

    formats = PANORAMA_FORMATS

    panorama_height: int = HEIGHT

    def __post_init__(self) -> None:
        super().__post_init__()
        self._not_made = Problems()

    def make_files(self) -> None:
        """Generate the panoramas of sequences without or with unfinished panoramas.

        Raises:
            DataError: The views are missing or broken.
        """
        self._not_made = Problems()
        make_panoramas(
            self.root,
            self.sequences,
            self._not_made,
            frames=self.frames,
            height=self.panorama_height,
        )
        if not self.skip_broken:
            self._not_made.refuse(self.root, "data.skip_broken=true leaves out these frames.")

    def find(self, problems: Problems) -> Found[ImageFiles]:
        """See `SplitDataModule`; panoramas that could not be generated count as broken."""
        problems.add_all(self._not_made)
        return super().find(problems)

    def list_images(self, sequence: str, *, with_depth: bool) -> list[list[ImageFiles]]:
        """See `SynthiaSequences`."""
        folder = sequence_folder(self.root, sequence)
        frames = list_panoramas(folder)
        if not frames:
            raise DataError(
                folder / "pano" / "RGB",
                found="no panoramas",
                expected="000000.png and others",
                remedy=f"Run tangent-prepare to make them from the views. {GET_IT}",
            )
        return [
            [panorama_files(self.root, sequence, frame, with_depth=with_depth)] for frame in frames
        ]


@registered
@dataclass(kw_only=True, eq=False, repr=False)
class SynthiaPerspective(SynthiaSequences, PhotoDataModule):
    """SYNTHIA's views, 13 classes, of the frames and in the splits of OmniSYNTHIA.

    Raises:
        SettingError: A setting is invalid.
    """

    formats = VIEW_FORMATS

    def list_images(self, sequence: str, *, with_depth: bool) -> list[list[ImageFiles]]:
        """See `SynthiaSequences`."""
        folder = sequence_folder(self.root, sequence)
        frames = choose_frames(list_frames(folder), self.frames)
        if not frames:
            raise DataError(
                views_folder(folder, VIEWS[0]),
                found="no views",
                expected="000000.png and others",
                remedy=GET_IT,
            )
        return [
            [view_files(self.root, sequence, frame, v, with_depth=with_depth) for v in VIEWS]
            for frame in frames
        ]
