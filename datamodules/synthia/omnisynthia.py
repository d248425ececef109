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
from itertools import chain
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PositiveInt

from datamodules.core.data_module import data_set
from datamodules.core.depth import meters_to_steps
from datamodules.core.files import ImageFiles, Problems, Split
from datamodules.core.image_module import ImageDataModule, PanoramaDataModule, PhotoDataModule
from datamodules.core.inputs import RGBD_NORMALIZATION, Normalization
from datamodules.core.label_map import LabelMap
from datamodules.synthia import reader
from datamodules.synthia.generate import HEIGHT, make_panoramas
from tangent_train.errors import DataError
from tangent_train.io.pixel_files import read_image_size

# YAML reads 01 as a number.
Sequences = Sequence[
    Annotated[
        Literal["01", "02", "04", "05", "06"], BeforeValidator(lambda given: str(given).zfill(2))
    ]
]
"""Names of sequences; OmniSYNTHIA uses the summer versions."""

_MEAN, _STD = (0.4512, 0.4257, 0.3920), (0.2601, 0.2680, 0.2931)
_NORMALIZATIONS = (
    Normalization(_MEAN, _STD),
    Normalization((*_MEAN, RGBD_NORMALIZATION.mean[3]), (*_STD, RGBD_NORMALIZATION.std[3])),
)
"""RGB as in the released code of the paper. For depth, where
nothing is published, the values of Stanford2D3DS are used, with the same clipping."""

_LABELS = LabelMap.of(
    # Traffic lights are 15. The reserved 13 and 14 are unknown: the published panoramas were
    # averaged where views overlap, which may have made some.
    dict(zip(reader.CLASSES, (*range(1, 13), 15), strict=True)),
    [0, 13, 14, reader.INVALID],
)


@data_set
class SynthiaSequences(ImageDataModule):
    """The training and test sequences of OmniSYNTHIA's authors.

    Validation takes the last frames of each training sequence. Depth is clipped to 4 m, which is
    short for streets.

    Args:
        train_sequences: Sequences for training, e.g. ``01``.
        test_sequences: Sequences for the test, e.g. ``04``.
        frames: Approximate number of frames per sequence, see `choose_frames`.
    """

    label_maps: ClassVar[Mapping[str, LabelMap]] = {"13": _LABELS}
    normalizations = _NORMALIZATIONS
    get_it = reader.GET_IT
    fact_settings: ClassVar[tuple[str, ...]] = ("test_sequences",)

    train_sequences: Annotated[Sequences, Field(min_length=1)] = ("01", "02", "05", "06")
    test_sequences: Annotated[Sequences, Field(min_length=1)] = ("04",)
    frames: PositiveInt = reader.FRAMES

    def __post_init__(self) -> None:
        super().__post_init__()
        both = set(self.train_sequences) & set(self.test_sequences)
        self.refuse("test_sequences", both, "sequences that are not for training")

    @abstractmethod
    def list_images(self, sequence: str) -> list[list[ImageFiles]]:
        """Return the images of every frame of a sequence, if any."""

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        splits: dict[Split, list[ImageFiles]] = {"train": [], "val": [], "test": []}
        for sequence in (*self.train_sequences, *self.test_sequences):
            found = self.list_images(sequence)
            if not found:
                folder, none = reader.sequence_folder(self.root, sequence), f"no {self.noun}"
                expected = "000000.png …"
                raise DataError(folder, found=none, expected=expected, remedy=reader.GET_IT)
            if not self.reads_depth:
                found = [[files._replace(depth=None) for files in frame] for frame in found]
            # Neighboring frames are nearly identical: validation takes those at the end.
            held = min(max(1, round(self.val_fraction * len(found))), len(found) - 1)
            last = len(found) - held if self.val_fraction else len(found)
            is_test = sequence in self.test_sequences
            splits["test" if is_test else "train"] += chain.from_iterable(found[:last])
            splits["test" if is_test else "val"] += chain.from_iterable(found[last:])
        return splits

    def decode_labels(self, files: ImageFiles) -> NDArray[np.uint8]:
        """See `ImageDataModule`."""
        path: Any = files.labels
        return _LABELS.decode(reader.read_first_channel(path), path)

    def decode_depth(self, files: ImageFiles) -> NDArray[np.uint16]:
        """See `ImageDataModule`: centimeters in the first channel."""
        path: Any = files.depth
        return meters_to_steps(reader.read_first_channel(path) / np.float32(100))


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

    panorama_height: PositiveInt = HEIGHT

    def make_files(self) -> None:
        """Generate missing panoramas of all sequences.

        Raises:
            DataError: A view is broken.
        """
        broken = Problems()
        sequences = (*self.train_sequences, *self.test_sequences)
        size = {"frames": self.frames, "height": self.panorama_height}
        make_panoramas(self.root, sequences, broken, **size)
        if not self.skip_broken:
            broken.refuse(self.root, "data.skip_broken=true leaves out these frames.")

    def list_images(self, sequence: str) -> list[list[ImageFiles]]:
        """See `SynthiaSequences`."""
        folder = reader.sequence_folder(self.root, sequence)
        frames = reader.list_frames(folder, "pano/RGB")
        return [[reader.panorama_files(folder, frame)] for frame in frames]


@data_set
class SynthiaPerspective(SynthiaSequences, PhotoDataModule):
    """SYNTHIA's views, 13 classes, in the frames and splits of OmniSYNTHIA."""

    def list_images(self, sequence: str) -> list[list[ImageFiles]]:
        """See `SynthiaSequences`."""
        folder = reader.sequence_folder(self.root, sequence)
        frames = reader.choose_frames(reader.list_frames(folder), self.frames)
        return [[reader.view_files(folder, frame, v) for v in reader.VIEWS] for frame in frames]

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """See `ImageDataModule`: the camera of all views of the sequence."""
        return reader.read_view_camera(files.rgb.parents[3], read_image_size(files.rgb))
