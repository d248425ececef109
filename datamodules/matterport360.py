"""Panoramas of Matterport3D (Chang et al. 2017) in the two releases that benchmarks use.

Matterport3D has no panoramas with classes. Two groups made them from its photos and meshes, with
different classes and scenes: ten scenes for training in `sfss` are for the test in `360fv`.

On disk, as released; 8-bit labels, 16-bit depth, 0 = missing::

    root/                            release=360fv (360FV-Matterport, of 360BEV)
      <scene>/rgb/<uuid>.png         or .jpg
      <scene>/semantic/<uuid>.png    0 to 41, see ``tables``
      <scene>/depth/<uuid>.png       1/4000 m
    root/                            release=sfss (Matterport3D-1K, of SFSS-MMSI)
      <scene>/panorama/undistorted_color_images/<uuid>.png
      <scene>/panorama/segmentation_maps_classes/<uuid>.png    0 to 41, one higher than above
      <scene>/panorama/undistorted_depth_images/<uuid>.png     taken as 1/4000 m
      train.txt validation.txt test.txt    not read: they are known to be incomplete

``tables/matterport360_scenes.csv`` has the scenes of each split.

License: that of Matterport3D, academic use, on request: https://niessner.github.io/Matterport.

Citation: A. Chang, A. Dai, T. Funkhouser, M. Halber, M. Nießner, M. Savva, S. Song, A. Zeng,
Y. Zhang: "Matterport3D: Learning from RGB-D Data in Indoor Environments", 3DV 2017.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import ClassVar, Literal

from datamodules.core.data_module import data_set
from datamodules.core.files import SPLITS, ImageFiles, Split
from datamodules.core.image_module import PanoramaDataModule
from datamodules.core.label_map import LabelMap
from datamodules.tables import read_table
from tangent_train.io.image_files import glob_files

_CATEGORIES = read_table("matterport360_classes")
_SCENES = read_table("matterport360_scenes")

CATEGORIES: tuple[str, ...] = tuple(row["category"] for row in _CATEGORIES)
"""Categories of the numbers 0 to 41 of `360fv`; those of `sfss` are one higher, 0 is the last."""

CLASSES: tuple[str, ...] = (
    *("wall", "floor", "chair", "door", "table", "picture", "furniture", "objects", "window"),
    *("sofa", "bed", "sink", "stairs", "ceiling", "toilet", "mirror", "shower", "bathtub"),
    *("counter", "shelving"),
)
"""The 20 classes of `360fv`."""


def _merged(column: str) -> LabelMap:
    """Return the 20 classes by a column of the table of classes."""
    members: dict[str, list[int]] = {name: [] for name in CLASSES}
    for number, row in enumerate(_CATEGORIES):
        members.get(row[column], []).append(number)
    return LabelMap.of(members, set(range(42)) - {n for ns in members.values() for n in ns})


_FOLDERS = {
    "360fv": ("rgb", "semantic", "depth"),
    "sfss": (
        "panorama/undistorted_color_images",
        "panorama/segmentation_maps_classes",
        "panorama/undistorted_depth_images",
    ),
}
"""Folders of a scene: color, classes, depth."""

_PUBLISHED = {"train": 7829, "val": 772, "test": 2014}
"""Panoramas of `360fv`."""


@data_set
class Matterport360(PanoramaDataModule):
    """Panoramas of Matterport3D, 20 classes, or 41 with ``release=sfss``.

    Args:
        release: `360fv` or `sfss`, see above.
        test_split: Published split of the test panoramas. With `val`, validation uses scenes
            drawn from the training scenes, so that nothing is selected on the test panoramas.
    """

    label_maps: ClassVar[Mapping[str, LabelMap]] = {
        "20": _merged("corrected"),
        "360bev": _merged("360bev"),
        "41": LabelMap.of(CATEGORIES[:-1], [0]),
    }
    units_per_m = 4000
    get_it = (
        "Request Matterport3D at https://niessner.github.io/Matterport, and its panoramas from "
        "https://github.com/jamycheung/360BEV or https://github.com/sguttikon/SFSS-MMSI."
    )
    fact_settings: ClassVar[tuple[str, ...]] = ("release", "test_split")

    release: Literal["360fv", "sfss"] = "360fv"
    test_split: Literal["test", "val"] = "test"  # type: ignore[misc]

    def find_label_map(self) -> LabelMap:
        """See `ImageDataModule`; each release has other numbers."""
        possible = ("41",) if self.release == "sfss" else ("20", "360bev")
        self.classes = str(self.classes or possible[0])
        self.refuse("classes", self.classes not in possible, " or ".join(possible))
        return self.label_maps[self.classes]

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        splits: dict[Split, list[ImageFiles]] = {split: [] for split in SPLITS}
        for split, found in splits.items():
            scenes = [row["scene"] for row in _SCENES if row[self.release] == split]
            of_scenes = [self._list_images(scene) for scene in scenes]
            missing = [scene for scene, images in zip(scenes, of_scenes, strict=True) if not images]
            found.extend(chain.from_iterable(of_scenes))
            if missing:
                self.problems.warnings.append(
                    f"{len(missing)} of {len(scenes)} scenes of {split} are missing, such as "
                    f"{', '.join(missing[:3])}"
                )
        if self.release == "360fv":
            self.problems.compare_counts(splits, _PUBLISHED)
        return splits

    def _list_images(self, scene: str) -> list[ImageFiles]:
        rgb, *folders = (self.root / scene / folder for folder in _FOLDERS[self.release])
        found = {path.stem: path for end in ("jpg", "png") for path in glob_files(rgb, f"*.{end}")}
        images = []
        for stem, path in sorted(found.items()):
            labels, depth = (folder / f"{stem}.png" for folder in folders)
            with_depth = depth if self.reads_depth else None
            images.append(ImageFiles(f"{scene}/{stem}", path, labels, with_depth))
        return images
