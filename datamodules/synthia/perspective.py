"""SYNTHIA's views as photos (Ros et al. 2016): the sources of OmniSYNTHIA's panoramas.

`files` has the tree on disk, `omnisynthia` licence and citation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from datamodules.core.photo_module import PhotoDataModule
from datamodules.synthia.files import (
    GET_IT,
    VIEWS,
    list_frames,
    sequence_folder,
    view_files,
    views_folder,
)
from datamodules.synthia.reader import VIEW_FORMATS
from datamodules.synthia.splits import SynthiaSequences, choose_frames
from tangent_train.errors import DataError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from datamodules.core.reading import ImageFiles

__all__ = ["SynthiaPerspective"]


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
