"""OmniSYNTHIA (Zhang et al. 2019): panoramas of virtual streets, from SYNTHIA (Ros et al. 2016).

On disk the panoramas are 2096×4192, see `synthia_files`. They show what four cameras saw: a band
around the horizon, black and unknown above and below. Where there are none yet, they are made from
the four views of SYNTHIA's sequences 01, 02, 04, 05 and 06 SUMMER, which are free for research:
http://synthia-dataset.net.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from datamodules.core.panorama_module import PanoramaDataModule, Split
from datamodules.core.panoramas import Panorama, resize_area, resize_depth, resize_nearest
from datamodules.core.problems import Problems
from datamodules.core.samples import Input, Normalization
from datamodules.core.sources import count_labels
from datamodules.images.png import check_panorama_size, read_color_png
from datamodules.synthia.files import (
    GET_IT,
    PANORAMA_FORMATS,
    PictureFiles,
    check_files,
    check_root,
    list_panoramas,
    panorama_files,
    sequence_folder,
)
from datamodules.synthia.panoramas import HEIGHT, make_panoramas
from datamodules.synthia.pixels import (
    CLASSES,
    decode_labels,
    default_normalization,
    depth_steps,
    read_first_channel,
)
from datamodules.synthia.splits import FRAMES, TEST, TRAIN, SequenceSplits
from tangent_train.errors import DataError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from tangent_train.rendering.representations.pinhole import Representation

__all__ = ["OmniSynthia", "SynthiaPanoramas"]

_SKIP = "data.skip_broken=true leaves out these frames."


class _PanoramaName(NamedTuple):
    """Which panorama it is, and its files."""

    sequence: str
    frame: str
    files: PictureFiles


class SynthiaPanoramas:
    """Reads panoramas at one size.

    Args:
        panoramas: Which.
        erp_height: Rows to read.
    """

    def __init__(self, panoramas: Sequence[_PanoramaName], erp_height: int) -> None:
        self._panoramas = tuple(panoramas)
        self._shape = (erp_height, 2 * erp_height)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the panoramas."""
        return self._shape

    @property
    def variant(self) -> str:
        """The size."""
        return f"{self._shape[0]}x{self._shape[1]}"

    @property
    def settings(self) -> dict[str, str]:
        """The size."""
        return {"size": self.variant}

    def files(self, index: int) -> dict[str, Path]:
        """The file of every part of one panorama."""
        return dict(self._panoramas[index].files.parts)

    def __len__(self) -> int:
        return len(self._panoramas)

    def name(self, index: int) -> str:
        """Sequence and frame of a panorama, as ``sequence_01/000000``."""
        sequence, frame, _ = self._panoramas[index]
        return f"sequence_{sequence}/{frame}"

    def read(self, index: int) -> Panorama:
        """One panorama.

        Raises:
            DataError: A file is broken or holds strange labels.
        """
        files = self._panoramas[index].files
        rgb = resize_area(read_color_png(files.rgb), self._shape)
        depth = None
        if files.depth is not None:
            depth = depth_steps(resize_depth(read_first_channel(files.depth), self._shape))
        return Panorama(rgb, depth, self._labels(files.labels))

    def readers(self, index: int) -> Iterator[Callable[[], object]]:
        """What reads the files of one panorama, one after the other."""
        files = self._panoramas[index].files
        yield lambda: read_color_png(files.rgb)
        yield lambda: self._labels(files.labels)
        if files.depth is not None:
            depth = files.depth
            yield lambda: read_first_channel(depth)

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label of one panorama, ``(256,)``.

        Raises:
            DataError: A file is broken or holds strange labels.
        """
        return count_labels(self._labels(self._panoramas[index].files.labels))

    def _labels(self, path: Path) -> NDArray[np.uint8]:
        return resize_nearest(decode_labels(read_first_channel(path), path), self._shape)


@registered
class OmniSynthia(PanoramaDataModule):
    """OmniSYNTHIA, 13 classes, with the training and test sequences of its authors.

    Args:
        root: Folder with ``SYNTHIA-SEQS-01-SUMMER`` …, each with the four views or with panoramas.
        representation: What the network sees of a panorama.
        train_sequences: As ``01``.
        test_sequences: As ``04``.
        validation_fraction: Share of the training panoramas for validation: the last ones of each
            sequence, at least one, never all; 0 for no validation.
        frames: About how many panoramas of each sequence to make, see `choose_frames`.
        panorama_height: Rows of those that are made.
        inputs: See `SegmentationDataModule`. Depth is clipped to 4 m, which is little in a street;
            the published panoramas have the z-depth of the views instead of distance.
        normalization: Of RGB and depth, see `default_normalization`.
        **settings: All others of `PanoramaDataModule`.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names = ("unknown", *CLASSES)

    def __init__(
        self,
        root: str | Path,
        representation: Representation,
        *,
        train_sequences: Sequence[str] = TRAIN,
        test_sequences: Sequence[str] = TEST,
        validation_fraction: float = 0.1,
        frames: int = FRAMES,
        panorama_height: int = HEIGHT,
        inputs: Sequence[Input] = ("rgb",),
        normalization: Normalization | None = None,
        **settings: Any,
    ) -> None:
        normalization = normalization or default_normalization(inputs)
        super().__init__(representation, inputs=inputs, normalization=normalization, **settings)
        self._division = SequenceSplits(
            tuple(train_sequences), tuple(test_sequences), validation_fraction
        )
        self.root = Path(root)
        self.validation_fraction = validation_fraction
        self.frames = frames
        self.panorama_height = panorama_height
        self._not_made = Problems()

    def make_files(self) -> None:
        """Make the panoramas of sequences that have none yet, or are not finished.

        Raises:
            DataError: There is nothing to make them from, or it is broken.
        """
        check_root(self.root)
        self._not_made = problems = Problems()
        make_panoramas(
            self.root,
            self._division.sequences,
            frames=self.frames,
            height=self.panorama_height,
            noted=problems.noted,
        )
        if not self.skip_broken:
            problems.refuse(self.root, left=1, more=_SKIP)

    def find_splits(self) -> dict[Split, SynthiaPanoramas]:
        """The panoramas of all splits, checked.

        Raises:
            DataError: Something is missing or cannot be used.
            SettingError: The panoramas are too small for the representation.
        """
        check_root(self.root)
        self.problems.add_all(self._not_made)
        return {
            split: SynthiaPanoramas(self.problems.without(panoramas), self.erp_height)
            for split, panoramas in self._division.divide(self._panoramas).items()
        }

    def _panoramas(self, sequence: str) -> list[_PanoramaName]:
        """The panoramas of a sequence, all of them checked."""
        folder = sequence_folder(self.root, sequence)
        noted = self.problems.noted
        frames: list[str] = []
        with noted():
            frames = list_panoramas(folder)
            if not frames:
                raise DataError(
                    folder / "pano" / "RGB",
                    found="no panoramas",
                    expected="000000.png and others",
                    remedy=f"Run tangent-prepare to make them from the views. {GET_IT}",
                )
        found = []
        for frame in frames:
            files = panorama_files(folder, frame, with_depth=self.with_depth)
            panorama = _PanoramaName(sequence, frame, files)
            size = check_files(files, PANORAMA_FORMATS, noted, panorama)
            with noted(panorama, files.rgb):
                if any(size):
                    check_panorama_size(files.rgb, size, self.erp_height)
            found.append(panorama)
        return found
