"""SYNTHIA's views as photos (Ros et al. 2016): those that OmniSYNTHIA's panoramas are made of.

On disk as released, see `synthia_files`; free for research: http://synthia-dataset.net.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from datamodules.core.photo_module import PhotoDataModule, Split
from datamodules.core.photos import Photo, distance_from_z_depth
from datamodules.core.samples import Input, Normalization
from datamodules.core.sources import count_labels, in_threads
from datamodules.images.png import read_color_png
from datamodules.synthia.files import (
    GET_IT,
    VIEW_FORMATS,
    VIEWS,
    PictureFiles,
    check_files,
    check_root,
    list_frames,
    read_camera,
    sequence_folder,
    view_files,
    views_folder,
)
from datamodules.synthia.pixels import (
    CLASSES,
    decode_labels,
    default_normalization,
    depth_steps,
    read_first_channel,
    read_view_labels,
)
from datamodules.synthia.splits import FRAMES, TEST, TRAIN, SequenceSplits, choose_frames
from tangent_train.errors import DataError
from tangent_train.registry import registered

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from tangent_train.rendering.representations.perspective import PerspectiveRepresentation

__all__ = ["SynthiaPerspective", "SynthiaPhotos"]


class _View(NamedTuple):
    """Which photo it is, its files and its camera."""

    name: str
    files: PictureFiles
    camera_matrix: NDArray[np.float64]


class SynthiaPhotos:
    """Reads photos.

    Args:
        views: Which.
    """

    def __init__(self, views: Sequence[_View]) -> None:
        self._views = tuple(views)

    def __len__(self) -> int:
        return len(self._views)

    def name(self, index: int) -> str:
        """Sequence, frame and view of a photo, as ``sequence_01/000000/F``."""
        return self._views[index].name

    def read(self, index: int) -> Photo:
        """One photo.

        Raises:
            DataError: A file is broken or holds strange labels.
        """
        _, files, camera_matrix = self._views[index]
        depth = None
        if files.depth is not None:
            centimeters = read_first_channel(files.depth)
            depth = depth_steps(distance_from_z_depth(centimeters, camera_matrix))
        rgb = read_color_png(files.rgb)
        return Photo(rgb, depth, _read_labels(files.labels), camera_matrix)

    def readers(self, index: int) -> Iterator[Callable[[], object]]:
        """What reads the files of one photo, one after the other."""
        files = self._views[index].files
        yield lambda: read_color_png(files.rgb)
        yield lambda: _read_labels(files.labels)
        if files.depth is not None:
            depth = files.depth
            yield lambda: read_first_channel(depth)

    def label_counts(self, index: int) -> NDArray[np.int64]:
        """The pixels of every label of one photo, ``(256,)``.

        Raises:
            DataError: A file is broken or holds strange labels.
        """
        return count_labels(_read_labels(self._views[index].files.labels))


def _read_labels(path: Path) -> NDArray[np.uint8]:
    return decode_labels(read_view_labels(path), path)


@registered
class SynthiaPerspective(PhotoDataModule):
    """SYNTHIA's views, 13 classes, of the frames and in the splits of OmniSYNTHIA.

    Args:
        root: Folder with ``SYNTHIA-SEQS-01-SUMMER`` ….
        representation: The camera that all photos are brought to.
        train_sequences: As ``01``.
        test_sequences: As ``04``.
        validation_fraction: Share of the training frames for validation: the last ones of each
            sequence, at least one, never all; 0 for no validation. As of the panoramas.
        frames: About how many frames of each sequence to use, see `choose_frames`.
        inputs: See `SegmentationDataModule`. Depth is clipped to 4 m, which is little in a street.
        normalization: Of RGB and depth, see `default_normalization`.
        **settings: All others of `PhotoDataModule`.

    Raises:
        SettingError: A setting that cannot work.
    """

    class_names = ("unknown", *CLASSES)

    def __init__(
        self,
        root: str | Path,
        representation: PerspectiveRepresentation,
        *,
        train_sequences: Sequence[str] = TRAIN,
        test_sequences: Sequence[str] = TEST,
        validation_fraction: float = 0.1,
        frames: int = FRAMES,
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

    def find_splits(self) -> dict[Split, SynthiaPhotos]:
        """The photos of all splits, checked.

        Raises:
            DataError: Something is missing or cannot be used; a photo sees less than a crop.
        """
        check_root(self.root)
        return {
            split: SynthiaPhotos([view for frame in frames for view in frame])
            for split, frames in self._division.divide(self._frames).items()
        }

    def _frames(self, sequence: str) -> list[list[_View]]:
        """The views of the chosen frames of a sequence, all of them checked."""
        folder = sequence_folder(self.root, sequence)
        frames: list[str] = []
        with self.problems.noted():
            frames = choose_frames(list_frames(folder), self.frames)
            if not frames:
                raise DataError(
                    views_folder(folder, VIEWS[0]),
                    found="no views",
                    expected="000000.png and others",
                    remedy=GET_IT,
                )
        return list(in_threads(lambda index: self._views(sequence, frames[index]), len(frames)))

    def _views(self, sequence: str, frame: str) -> list[_View]:
        """The views of one frame, checked, without those of which something was noted."""
        noted = self.problems.noted
        folder = sequence_folder(self.root, sequence)
        views = []
        for view in VIEWS:
            files = view_files(folder, view, frame, with_depth=self.with_depth)
            size = check_files(files, VIEW_FORMATS, noted, files)
            with noted(files):
                camera_matrix = read_camera(folder, size)
                self.check_camera(files.rgb, camera_matrix, size)
                views.append(_View(f"sequence_{sequence}/{frame}/{view}", files, camera_matrix))
        broken = self.problems.items
        return [view for view in views if view.files not in broken]
