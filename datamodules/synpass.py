"""SynPASS (Zhang et al. 2022): 9,080 panoramas of virtual streets in four weathers, 22 classes.

Features: 1024×2048 RGB of eight maps of the simulator CARLA, by day and by night.

On disk, as released::

    root/
      img/<weather>/<split>/MAP_1_point2/000000.jpg                 8 bit, 10 per point
      semantic/<weather>/<split>/MAP_1_point2/000000_trainID.png    8 bit, 0 to 22, 255 = unknown
      all_map_day_val.txt  all_map_night_val.txt                    names of points, if wanted

Weathers are cloud, fog, rain and sun; splits are train, val and test.

License: that of the data is not stated; the authors ask to be contacted before commercial use,
https://github.com/jamycheung/Trans4PASS.

Citation: J. Zhang, K. Yang, H. Shi, S. Reiß, K. Peng, C. Ma, H. Fu, P. H. S. Torr, K. Wang,
R. Stiefelhagen: "Behind Every Domain There is a Shift: Adapting Distortion-aware Vision
Transformers for Panoramic Semantic Segmentation", arXiv:2207.11860, 2022.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from datamodules.cityscapes import THIRTEEN
from datamodules.core.data_module import data_set
from datamodules.core.files import SPLITS, ImageFiles, Split
from datamodules.core.image_module import PanoramaDataModule
from datamodules.core.label_map import LabelMap
from tangent_train.io.image_files import glob_files

CLASSES: tuple[str, ...] = (
    *("building", "fence", "other", "pedestrian", "pole", "road line", "road", "sidewalk"),
    *("vegetation", "vehicles", "wall", "traffic sign", "sky", "ground", "bridge"),
    *("rail track", "ground rail", "traffic light", "static", "dynamic", "water", "terrain"),
)
"""The 22 classes as labels 1 to 22, which are also the numbers in the files."""

Weather = Literal["cloud", "fog", "rain", "sun"]
"""Folders of the release."""

_MERGED = {"pedestrian": "person", "vehicles": "car", "road line": "road"}
_PUBLISHED = (
    {"train": 5700, "val": 1690, "test": 1690},
    {"train": 5700, "val": 2180, "test": 1200},
)
"""Images in the description of the release, and in the lists of its code."""

_TWENTY_TWO = LabelMap.of(CLASSES, [0, 255])


@data_set
class SynPASS(PanoramaDataModule):
    """SynPASS, 22 or 13 classes, with the splits of its folders.

    Args:
        weather: One or several weathers, or `all`.
        time: `all`; `day` or `night` keeps the test panoramas that a list of the release names:
            the lists of the release name points of `val`.
        test_split: Folder of the test panoramas. With `val`, validation uses points drawn from
            the training folder, so that nothing is selected on the test panoramas.
    """

    label_maps: ClassVar[Mapping[str, LabelMap]] = {
        "22": _TWENTY_TWO,
        "13": _TWENTY_TWO.regrouped(THIRTEEN, _MERGED),
    }
    no_depth = "SynPASS has no depth images"
    get_it = "Get SynPASS from https://github.com/jamycheung/Trans4PASS."
    fact_settings: ClassVar[tuple[str, ...]] = ("weather", "time", "test_split")

    weather: Literal["all"] | Weather | Annotated[Sequence[Weather], Field(min_length=1)] = "all"
    time: Literal["all", "day", "night"] = "all"
    test_split: Literal["test", "val"] = "test"  # type: ignore[misc]

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        splits = {split: self._list_images(split) for split in SPLITS}
        if self.weather == "all":
            self.problems.compare_counts(splits, *_PUBLISHED)
        if self.time != "all":
            named = self._points_of_times.get(self.time, set())
            tested = [files for files in splits[self.test_split] if _point(files) in named]
            splits[self.test_split] = tested
        return splits

    def groups(self, files: ImageFiles) -> list[str]:
        """See `DataModule`: weather, and day or night where a list names the point."""
        times = (t for t, points in self._points_of_times.items() if _point(files) in points)
        return [files.name.split("/")[1], *times]

    def _list_images(self, split: Split) -> list[ImageFiles]:
        """Return the images of a folder, each with the label image of its name."""
        found: list[ImageFiles] = []
        chosen = [self.weather] if isinstance(self.weather, str) else self.weather
        for weather in ("cloud", "fog", "rain", "sun") if "all" in chosen else chosen:
            place = Path(weather, split)
            for rgb in glob_files(self.root / "img" / place, "*/*.jpg"):
                mask = self.root / "semantic" / place / rgb.parent.name / f"{rgb.stem}_trainID.png"
                found.append(ImageFiles(f"{rgb.parent.name}/{weather}/{rgb.stem}", rgb, mask))
        return found

    @cached_property
    def _points_of_times(self) -> dict[str, set[str]]:
        """Points in the lists of the release, which may be missing."""
        return {
            time: set(re.findall(r"MAP_\d+_point\d+", path.read_text("utf-8")))
            for time in ("day", "night")
            for path in self.root.glob(f"all_map_{time}_val.txt")
        }


def _point(files: ImageFiles) -> str:
    """Return the point of an image, e.g. ``MAP_1_point2``."""
    return files.name.partition("/")[0]
