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
from functools import cached_property
from itertools import chain
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from datamodules.core.data_module import data_set
from datamodules.core.image_module import ImageDataModule, PhotoDataModule
from datamodules.core.images import ImageFiles, units_to_steps
from datamodules.core.inputs import Input
from datamodules.core.label_map import LabelMap
from datamodules.core.panorama_module import PanoramaDataModule
from datamodules.core.problems import Problems
from datamodules.core.splits import Split
from datamodules.synthia import reader
from datamodules.synthia.generate import HEIGHT, make_panoramas
from tangent_train.errors import DataError, SettingError
from tangent_train.io.pixel_files import read_image_size

SEQUENCES: tuple[str, ...] = ("01", "02", "04", "05", "06")
"""Available sequences; OmniSYNTHIA uses the summer versions."""

TRAIN: tuple[str, ...] = ("01", "02", "05", "06")
TEST: tuple[str, ...] = ("04",)
"""The split of Zhang et al. 2019."""


@data_set
class SynthiaSequences(ImageDataModule):
    """The training and test sequences of OmniSYNTHIA's authors.

    Validation takes the last frames of each training sequence. Depth is clipped to 4 m, which is
    short for streets.

    Args:
        train_sequences: Sequences for training, e.g. ``01``.
        test_sequences: Sequences for the test, e.g. ``04``.
        frames: Approximate number of frames per sequence, see `choose_frames`.

    Attributes:
        remedy: Remedy if there are no images.
    """

    label_maps: ClassVar[Mapping[str, LabelMap]] = {"13": reader.LABELS}
    normalizations = reader.NORMALIZATIONS
    remedy: ClassVar[str] = reader.GET_IT

    fact_settings: ClassVar[tuple[str, ...]] = ("test_sequences",)

    inputs: Sequence[Input] = ("rgb",)
    train_sequences: Sequence[str | int] = TRAIN
    test_sequences: Sequence[str | int] = TEST
    frames: int = reader.FRAMES

    def __post_init__(self) -> None:
        super().__post_init__()
        others: tuple[str, ...] = ()
        for name in ("train_sequences", "test_sequences"):
            # YAML reads 01 as a number.
            some = tuple(str(sequence).zfill(2) for sequence in getattr(self, name))
            setattr(self, name, some)
            if not some or set(some) & set(others) or not set(some) <= set(SEQUENCES):
                expected = f"some of {', '.join(SEQUENCES)}, none for both training and test"
                raise SettingError(f"data.{name}", found=list(some), expected=expected)
            others = some

    @property
    def sequences(self) -> tuple[str, ...]:
        """Training sequences, then test sequences."""
        chosen: Any = (*self.train_sequences, *self.test_sequences)
        return chosen  # texts of two digits

    def decode_depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """Read depth in centimeters, of which views have several equal channels."""
        return units_to_steps(reader.read_first_channel(files.paths[2]), 100)

    def decode_labels(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Read the classes in the first channel; in views, the others hold instances."""
        path = files.paths[1]
        return reader.LABELS.decode(reader.read_first_channel(path), path)

    @abstractmethod
    def list_images(self, sequence: str, *, with_depth: bool) -> list[list[ImageFiles]]:
        """Return the images of every frame of a sequence, if any."""

    def files(self, split: Split) -> list[ImageFiles]:
        """See `DataModule`."""
        return self._splits_of_sequences[split]

    @cached_property
    def _splits_of_sequences(self) -> dict[Split, list[ImageFiles]]:
        found: dict[str, list[list[ImageFiles]]] = {}
        for sequence in self.sequences:
            found[sequence] = []
            with self.problems.noted():
                found[sequence] = self.list_images(sequence, with_depth=self.reads_depth)
                if not found[sequence]:
                    raise DataError(
                        reader.sequence_folder(self.root, sequence),
                        found=f"no {self.noun}",
                        expected="000000.png and others",
                        remedy=self.remedy,
                    )
        return divide(found, list(map(str, self.test_sequences)), self.val_fraction)


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


@data_set
class OmniSynthia(SynthiaSequences, PanoramaDataModule):
    """OmniSYNTHIA, 13 classes, with the training and test sequences of its authors.

    `root` holds ``SYNTHIA-SEQS-01-SUMMER`` …, each with the four views or with panoramas; missing
    panoramas are generated from `frames` frames. The published panoramas have the z-depth of
    the views instead of distance.

    Args:
        panorama_height: Rows of generated panoramas.
    """

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

    def files(self, split: Split) -> list[ImageFiles]:
        """See `DataModule`; panoramas that could not be generated are broken."""
        if split == "train":
            self.problems.add_all(self._not_made)
        return super().files(split)

    def list_images(self, sequence: str, *, with_depth: bool) -> list[list[ImageFiles]]:
        """See `SynthiaSequences`."""
        return [
            [reader.panorama_files(self.root, sequence, frame, with_depth=with_depth)]
            for frame in reader.list_panorama_frames(reader.sequence_folder(self.root, sequence))
        ]


@data_set
class SynthiaPerspective(SynthiaSequences, PhotoDataModule):
    """SYNTHIA's views, 13 classes, in the frames and splits of OmniSYNTHIA."""

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """Read the camera matrix of the view's sequence."""
        return reader.read_view_camera(files.rgb.parents[3], read_image_size(files.rgb))

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
