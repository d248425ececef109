"""User-defined folders of images, label images and a list of classes, for panoramas and photos.

On disk::

    root/
      classes.json                  see `read_classes`
      images/[scene/]…/name.jpg     or .png, .tif, .webp
      labels/[scene/]…/name.png     values or colors of the classes, at the size of the image
      depth/[scene/]…/name.png      or .tif, .npy, .exr, if depth is an input, see `read_depth_m`
      train.txt val.txt test.txt    if wanted, names one per line, see `FolderSplits`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datamodules.core.image_module import ImageDataModule, PanoramaDataModule, PhotoDataModule
from datamodules.core.index import Split
from datamodules.core.inputs import Input
from datamodules.core.labeled_data import print_on_rank_zero
from datamodules.core.panoramas import ImageFiles
from datamodules.core.problems import Problems
from datamodules.folder.cameras import read_folder_cameras
from datamodules.folder.classes import NO_CLASSES, UNKNOWN_NAME, read_classes
from datamodules.folder.reader import FolderReader, list_images, note_ignored, read_codes
from datamodules.folder.splits import FolderSplits
from tangent_train.errors import DataError
from tangent_train.io.image_files import image_paths

_TRIED = 4


@dataclass(kw_only=True, eq=False, repr=False)
class LabeledFolder(ImageDataModule):
    """Files, splits and classes of a user-defined data set. Depth is clipped to 4 m.

    Args:
        test_fraction: Share of the scenes for the test, without lists, see `FolderSplits`;
            `val_fraction` is a share of the training scenes.
        split_seed: Seed of both splits. Independent of the run's seed, so that runs with
            different seeds share their splits.
        depth_units_per_m: Units per meter of integer depth files, 1000 for millimeters.

    Attributes:
        class_names: "unknown", then those of ``classes.json``.

    Raises:
        DataError: ``classes.json`` is missing or cannot be used.
        SettingError: A setting is invalid.
    """

    inputs: Sequence[Input] = ("rgb",)
    test_fraction: float = 0.2
    split_seed: int = 0
    depth_units_per_m: float = 1000

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("depth_units_per_m", self.depth_units_per_m > 0, "more than 0")
        self.require("test_fraction", 0 < self.test_fraction < 1, "above 0 to below 1")
        self.require("split_seed", self.split_seed >= 0, "0 or more")
        self._classes = NO_CLASSES
        if not self.has_distances:
            # Read now, not with the images: the network needs the number of classes.
            self._classes = read_classes(self.root / "classes.json")
            self.class_names = (UNKNOWN_NAME, *self._classes.names)

    def find_images(self, problems: Problems) -> tuple[FolderReader, dict[Split, list[ImageFiles]]]:
        """See `ImageDataModule`."""
        with_labels = not self.has_distances
        images = list_images(
            self.root, problems, with_labels=with_labels, with_depth=self.reads_depth
        )
        # Before broken images are left out, so that the splits do not depend on them.
        division = FolderSplits(self.root, self.test_fraction, self.val_fraction, self.split_seed)
        splits: dict[Split, list[ImageFiles]] = {"train": images, "val": [], "test": []}
        # The images are checked even if these checks fail.
        with problems.noted():
            splits = division.divide(images, problems)
        with problems.noted():
            some = problems.without(images)[:_TRIED] if with_labels else ()
            self._check_classes(some, problems)
        return self.make_reader(images, problems), splits

    def prepare_data(self) -> None:
        """See `SplitDataModule`; files that are not images are counted."""
        super().prepare_data()
        image_paths(self.root / "images", tell=print_on_rank_zero)

    def check(self) -> tuple[Problems, int]:
        """See `LabeledData`; also names files that training ignores."""
        problems, count = super().check()
        with problems.noted():
            note_ignored(self.root, "depth" if self.has_distances else "labels", problems)
        return problems, count

    def make_reader(self, images: Sequence[ImageFiles], problems: Problems) -> FolderReader:
        """Return the reader of the images.

        Args:
            images: All images of the data set.
            problems: Collects problems of the other files that it reads.

        Raises:
            DataError: The data set as a whole cannot be used.
        """
        del images, problems
        return FolderReader(self._classes, self.depth_units_per_m)

    def _check_classes(self, images: Sequence[ImageFiles], problems: Problems) -> None:
        """Check the class list against the first few label images."""
        classes = self._classes
        reader = FolderReader(classes, self.depth_units_per_m)
        seen: set[int] = set()
        for files in images:
            with problems.noted(files.name):
                labels = files.parts["labels"]
                reader.size("labels", labels)  # a later check refuses it less clearly
                stored = read_codes(labels, in_colors=classes.in_colors)
                if classes.decode(stored, labels).any():
                    return
                seen |= set(np.unique(classes.pack(stored)).tolist())
        if seen:
            shown = classes.describe(np.array(sorted(seen), np.int32))
            raise DataError(
                images[0].labels,
                found=f"{shown}, in this file and the next",
                expected=f"{classes.describe(classes.codes)}, from classes.json",
                remedy="Correct classes.json: no pixel would have a class.",
            )


@dataclass(kw_only=True, eq=False, repr=False)
class FolderPanoramas(LabeledFolder, PanoramaDataModule):
    """User-defined panoramas, with the classes of ``classes.json``.

    Raises:
        DataError: ``classes.json`` is missing or cannot be used.
        SettingError: A setting is invalid.
    """


@dataclass(kw_only=True, eq=False, repr=False)
class FolderPhotos(LabeledFolder, PhotoDataModule):
    """User-defined photos, with the classes of ``classes.json``.

    Args:
        fov: Horizontal field of view, in degrees, of photos that ``cameras.json`` does not name;
            None to read it from EXIF data.

    Raises:
        DataError: ``classes.json`` is missing or cannot be used.
        SettingError: A setting is invalid.
    """

    fov: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        fine = self.fov is None or 0 < self.fov < 180
        self.require("fov", fine, "degrees, more than 0 and less than 180")

    def make_reader(self, images: Sequence[ImageFiles], problems: Problems) -> FolderReader:
        """See `LabeledFolder`."""
        cameras = read_folder_cameras(self.root / "cameras.json", self.fov)
        cameras.check_names(images, problems)
        return FolderReader(self._classes, self.depth_units_per_m, cameras)
