"""Structured3D (Zheng et al. 2020): 21,835 rendered panoramas of rooms, and photos, 40 classes.

Features: 512×1024 RGB in three lightings and three states of furniture, depth and classes; all
panoramas are upright.

On disk, as released::

    root/scene_00000/2D_rendering/<room>/
      panorama/<full|simple|empty>/
        rgb_rawlight.png             8 bit; also rgb_warmlight, rgb_coldlight
        semantic.png                 8 bit, with a palette: the index is the class, 0 = unknown
        instance.png                 16 bit: number of the furniture, from 0; 65535 = background.
                                     Only in full, from Structured3D_bbox.zip
        depth.png                    16 bit, mm, 0 = missing
      perspective/<full|empty>/<n>/
        …                            the same files of a photo
        camera_pose.txt              position, view, up; HALF angles of view, in radians; 1

The documents of the release leave open which depth the files hold. Here it is taken as distance
from the center in panoramas, and as z-depth in photos, like the point clouds in issue 11 of its
repository. To check it, compare the points of a floor with a plane.

License: free for research, on request: https://structured3d-dataset.org.

Citation: J. Zheng, J. Zhang, J. Li, R. Tang, S. Gao, Z. Zhou: "Structured3D: A Large
Photo-realistic Dataset for Structured 3D Modeling", ECCV 2020.
"""

from __future__ import annotations

import math
from bisect import bisect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import numpy as np
from numpy.typing import NDArray

from datamodules.core.data_module import data_set
from datamodules.core.dataset import Labels
from datamodules.core.files import SPLITS, ImageFiles, Split
from datamodules.core.image_module import ImageDataModule, PanoramaDataModule, PhotoDataModule
from datamodules.core.label_map import PANOPTIC, LabelMap
from datamodules.stanford2d3ds.files import EIGHT
from tangent_train.io.image_files import glob_files
from tangent_train.io.pixel_files import read_image_size, read_pixels
from tangent_train.metrics.panoptic import LABEL

CLASSES: tuple[str, ...] = (
    *("wall", "floor", "cabinet", "bed", "chair", "sofa", "table", "door", "window", "bookshelf"),
    *("picture", "counter", "blinds", "desk", "shelves", "curtain", "dresser", "pillow", "mirror"),
    *("floor mat", "clothes", "ceiling", "books", "refrigerator", "television", "paper", "towel"),
    *("shower curtain", "box", "whiteboard", "person", "night stand", "toilet", "sink", "lamp"),
    *("bathtub", "bag", "other structure", "other furniture", "other prop"),
)
"""The 40 classes of NYUv2 as labels 1 to 40, which are also the numbers in the files."""

THINGS = tuple(
    name for name in CLASSES if name not in ("wall", "floor", "door", "window", "ceiling")
)
"""Classes that have objects in a panoptic map: furniture."""

INVALID = ("01155", "01192", "01714", "01816", "01852", "03398")
"""Scenes that the errata of the release call invalid; published lists of images hold them."""

_BACKGROUND = 65535
_PUBLISHED = {"train": 18362, "val": 1776, "test": 1697}
_FIRST = (0, 3000, 3250)
"""First scene of each split."""


class PublishedS3D8(LabelMap):
    """The 8 classes as the published readers of S3D8 compute them, to compare with their scores.

    They replace the numbers of an image in place, in ascending order. The new number of a class
    (from 0) may be the old number of a later one: floor (2) becomes 3, and 3 is cabinet; wall (1)
    becomes 6, and 6 is sofa. So floor is unknown in images with cabinets, and wall is sofa in
    images with sofas.
    """

    def decode(self, stored: NDArray[np.integer], path: object = "labels") -> NDArray[np.uint8]:
        """See `LabelMap`."""
        super().decode(stored, path)  # refuses other numbers
        numbers = stored.astype(np.int16)
        for number in np.unique(stored).tolist():
            numbers[numbers == number] = self.labels[number] - 1
        return (numbers + 1).astype(np.uint8)


_FORTY = LabelMap.of(CLASSES, [0])
_EIGHT = _FORTY.regrouped(EIGHT)


@data_set
class Structured3DImages(ImageDataModule):
    """Images of Structured3D in the splits of its authors.

    Args:
        configuration: Furniture of the rooms; photos have no `simple`.
        lighting: Lighting of the rooms.
        invalid_scenes: `keep` the scenes `INVALID`, as published evaluations do, or `leave_out`.
        test_split: Published split of the test images. With `val`, validation uses scenes drawn
            from the training scenes, so that nothing is selected on the test images.

    Attributes:
        place: Pattern of the folders of images in a room.
    """

    label_maps: ClassVar[Mapping[str, LabelMap]] = {
        "40": _FORTY,
        "8": _EIGHT,
        "published_s3d8": PublishedS3D8(_EIGHT.names, _EIGHT.labels),
    }
    units_per_m = 1000
    get_it = "Request Structured3D at https://structured3d-dataset.org."
    place: ClassVar[str]
    fact_settings: ClassVar[tuple[str, ...]] = (
        *("configuration", "lighting", "invalid_scenes", "test_split"),
    )

    configuration: Literal["full", "simple", "empty"] = "full"
    lighting: Literal["rawlight", "warmlight", "coldlight"] = "rawlight"
    invalid_scenes: Literal["keep", "leave_out"] = "keep"
    test_split: Literal["test", "val"] = "test"  # type: ignore[misc]

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        scenes = f"scene_{'[0-9]' * 5}/2D_rendering/*"
        pattern = f"{scenes}/{self.place.format(self.configuration)}/rgb_{self.lighting}.png"
        splits: dict[Split, list[ImageFiles]] = {split: [] for split in SPLITS}
        invalid = []
        for rgb in glob_files(self.root, pattern):
            folder, _, room, _, _, *number, _ = rgb.relative_to(self.root).parts
            scene = folder.removeprefix("scene_")
            invalid += [scene] if scene in INVALID else []
            if scene in INVALID and self.invalid_scenes == "leave_out":
                continue
            files = ImageFiles(
                "/".join((folder, room, *number)),
                rgb,
                rgb.with_name("semantic.png"),
                rgb.with_name("depth.png") if self.reads_depth else None,
                rgb.with_name("camera_pose.txt") if number else None,
            )
            splits[SPLITS[bisect(_FIRST, int(scene)) - 1]].append(files)
        if invalid:
            self.problems.warnings.append(
                f"{len(invalid)} {self.noun} of scenes that the errata call invalid: "
                f"{', '.join(sorted(set(invalid)))} (data.invalid_scenes={self.invalid_scenes})"
            )
        if isinstance(self, PanoramaDataModule) and self.invalid_scenes == "keep":
            self.problems.compare_counts(splits, _PUBLISHED)
        return splits


@data_set
class Structured3D(Structured3DImages, PanoramaDataModule):
    """The panoramas of Structured3D, 40 or 8 classes."""

    things = THINGS
    place = "panorama/{}"

    def decode_labels(self, files: ImageFiles) -> Labels:
        """See `ImageDataModule`; furniture without a number is unknown."""
        labels, path = super().decode_labels(files), cast("Path", files.labels)
        if self.labels != PANOPTIC:
            return labels
        numbers = read_pixels(path.with_name("instance.png"), indices=True)
        is_thing = np.isin(self.class_names, self.things)[labels]
        codes = labels * np.int32(LABEL) + (numbers + np.int32(1)) * is_thing
        return np.where(is_thing & (numbers == _BACKGROUND), 0, codes)


@data_set
class Structured3DPerspective(Structured3DImages, PhotoDataModule):
    """The photos of Structured3D, 40 or 8 classes."""

    place = "perspective/{}/*"

    configuration: Literal["full", "empty"] = "full"

    def decode_camera(self, files: ImageFiles) -> NDArray[np.float64]:
        """See `ImageDataModule`; the center is in the middle of the photo."""
        path: Any = files.camera
        half_x, half_y = map(float, path.read_text("utf-8").split()[9:11])
        height, width = read_image_size(files.rgb)
        x, y = width / 2, height / 2
        fx, fy = x / math.tan(half_x), y / math.tan(half_y)
        return np.array([[fx, 0, x - 0.5], [0, fy, y - 0.5], [0, 0, 1]])
