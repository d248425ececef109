"""OmniSYNTHIA (Zhang et al. 2019): panoramas of virtual streets, from SYNTHIA (Ros et al. 2016).

Features: 2096×4192 RGB, depth and 13 semantic classes (`reader.CLASSES`). The panoramas combine
four cameras: a band around the horizon, black and unknown above and below. Missing panoramas are
generated from the four views of SYNTHIA's sequences 01, 02, 04, 05 and 06 SUMMER, which are
photos too. `reader` has the tree on disk.

License: SYNTHIA is free for research: http://synthia-dataset.net.

Citation: G. Ros, L. Sellart, J. Materzynska, D. Vazquez, A. M. Lopez: "The SYNTHIA Dataset",
CVPR 2016. C. Zhang, S. Liwicki, W. Smith, R. Cipolla: "Orientation-aware Semantic Segmentation on
Icosahedron Spheres", ICCV 2019.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import ClassVar

from datamodules.core.image_module import ImageDataModule, PanoramaDataModule, PhotoDataModule
from datamodules.core.splits import DatasetIndex, Split
from datamodules.core.inputs import Input
from datamodules.core.images import ImageFiles
from datamodules.core.problems import Problems
from datamodules.synthia import reader
from datamodules.synthia.generate import HEIGHT, make_panoramas
from tangent_train.errors import DataError

SEQUENCES: tuple[str, ...] = ("01", "02", "04", "05", "06")
"""Available sequences; OmniSYNTHIA uses the summer versions."""

TRAIN: tuple[str, ...] = ("01", "02", "05", "06")
TEST: tuple[str, ...] = ("04",)
"""The split of Zhang et al. 2019."""


@dataclass(kw_only=True, eq=False, repr=False)
class SynthiaSequences(ImageDataModule):
    """The training and test sequences of OmniSYNTHIA's authors.

    Validation takes the last frames of each training sequence. Depth is clipped to 4 m, which is
    short for streets.

    Args:
        train_sequences: Sequences for training, e.g. ``01``.
        test_sequences: Sequences for the test, e.g. ``04``.
        frames: Approximate number of frames per sequence, see `choose_frames`.

    Attributes:
        formats: Formats of the files.
        remedy: Remedy if there are no images.

    Raises:
        SettingError: A setting is invalid.
    """

    class_names = ("unknown", *reader.CLASSES)
    normalizations = reader.NORMALIZATIONS
    formats: ClassVar[reader.Formats]
    remedy: ClassVar[str] = reader.GET_IT

    fact_settings: ClassVar[tuple[str, ...]] = ("test_sequences",)

    inputs: Sequence[Input] = ("rgb",)
    train_sequences: Sequence[str] = TRAIN
    test_sequences: Sequence[str] = TEST
    frames: int = reader.FRAMES

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
        """Training sequences, then test sequences."""
        return (*self.train_sequences, *self.test_sequences)

    @abstractmethod
    def list_images(self, sequence: str, *, with_depth: bool) -> list[list[ImageFiles]]:
        """Return the images of every frame of a sequence, if any."""

    def find_images(
        self, problems: Problems
    ) -> tuple[reader.SynthiaReader, dict[Split, list[ImageFiles]]]:
        """See `ImageDataModule`."""
        found: dict[str, list[list[ImageFiles]]] = {}
        for sequence in self.sequences:
            found[sequence] = []
            with problems.noted():
                found[sequence] = self.list_images(sequence, with_depth=self.reads_depth)
                if not found[sequence]:
                    raise DataError(
                        reader.sequence_folder(self.root, sequence),
                        found=f"no {self.noun}",
                        expected="000000.png and others",
                        remedy=self.remedy,
                    )
        splits = divide(found, self.test_sequences, self.val_fraction)
        return reader.SynthiaReader(self.formats), splits


def divide(
    frames: Mapping[str, Sequence[Sequence[ImageFiles]]],
    test: Sequence[str],
    val_fraction: float,
) -> dict[Split, list[ImageFiles]]:
    """Assign frames to splits.

    Neighboring frames are nearly identical, so validation takes those at the end of each training
    sequence.

    Args:
        frames: Images of each frame, by sequence and in order.
        test: Sequences for the test; all others are for training.
        val_fraction: Share of each training sequence for validation: at least one frame,
            at most all but one; 0 for no validation.
    """
    splits: dict[Split, list[ImageFiles]] = {"train": [], "val": [], "test": []}
    for sequence, found in frames.items():
        count = len(found)
        if sequence in test:
            splits["test"] += chain.from_iterable(found)
            continue
        held = min(max(1, round(val_fraction * count)), count - 1)
        last = count - held if val_fraction else count
        splits["train"] += chain.from_iterable(found[:last])
        splits["val"] += chain.from_iterable(found[last:])
    return splits


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

    formats = reader.PANORAMA_FORMATS
    no_distances = "published panoramas of OmniSYNTHIA have z-depth of the four views"
    remedy = f"Run tangent-prepare to generate them from the views. {reader.GET_IT}"

    panorama_height: int = HEIGHT

    def __post_init__(self) -> None:
        super().__post_init__()
        self._not_made = Problems()

    def make_files(self) -> None:
        """Generate missing panoramas of all sequences.

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

    def find(self, problems: Problems) -> DatasetIndex[ImageFiles]:
        """See `LabeledData`; panoramas that could not be generated are broken."""
        problems.add_all(self._not_made)
        return super().find(problems)

    def list_images(self, sequence: str, *, with_depth: bool) -> list[list[ImageFiles]]:
        """See `SynthiaSequences`."""
        return [
            [reader.panorama_files(self.root, sequence, frame, with_depth=with_depth)]
            for frame in reader.list_panorama_frames(reader.sequence_folder(self.root, sequence))
        ]


@dataclass(kw_only=True, eq=False, repr=False)
class SynthiaPerspective(SynthiaSequences, PhotoDataModule):
    """SYNTHIA's views, 13 classes, in the frames and splits of OmniSYNTHIA.

    Raises:
        SettingError: A setting is invalid.
    """

    formats = reader.VIEW_FORMATS

    def list_images(self, sequence: str, *, with_depth: bool) -> list[list[ImageFiles]]:
        """See `SynthiaSequences`."""
        frames = reader.list_frames(reader.sequence_folder(self.root, sequence))
        return [
            [
                reader.view_files(self.root, sequence, frame, v, with_depth=with_depth)
                for v in reader.VIEWS
            ]
            for frame in reader.choose_frames(frames, self.frames)
        ]
