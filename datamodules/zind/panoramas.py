"""ZInD, the Zillow Indoor Dataset (Cruz et al. 2021): 67,448 panoramas of 1,575 empty homes.

Features: 1024×2048 RGB, and room layouts of which labels of 5 classes are made, exact at any size.
The panoramas are upright. A sample tour of one home, 32 panoramas, needs no registration.

On disk, as released::

    root/                         sample_tour, or the folder of the whole set
      000/                        a folder for every home
        zind_data.json            layouts, doors, windows, openings, poses: see `homes`
        panos/floor_01_partial_room_09_pano_5.jpg
      zind_partition.json         homes of train, val and test; copied from the repository if wanted

A panorama is labeled by `layout_visible`, what its camera sees of the complete room. Left out are
panoramas without it: those taken outside of the room that was annotated in them, 5 in the sample.

====== ======= ====================================================================================
label  class   of the layout
====== ======= ====================================================================================
0      unknown openings, through which the next room is seen
1      ceiling level, at `ceiling_height`; others are drawn so too
2      floor   also the tripod, and what stands on the floor in front of a wall
3      wall    also kitchens, bathrooms, cupboards, open leaves of doors, frames
4      door    also open doorways, with what is seen through them; `doors=ignore` makes them unknown
5      window  also what is seen through it
====== ======= ====================================================================================

License: ZInD terms of use, for academic, non-commercial research:
https://bridgedataoutput.com/zillowterms.

Citation: S. Cruz, W. Hutchcroft, Y. Li, N. Khosravan, I. Boyadzhiev, S. B. Kang: "Zillow Indoor
Dataset: Annotated Floor Plans With 360º Panoramas and 3D Room Layouts", CVPR 2021.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeInt

from datamodules.core.data_module import data_set
from datamodules.core.images import ImageFiles
from datamodules.core.inputs import Input
from datamodules.core.label_map import LabelMap
from datamodules.core.panorama_module import PanoramaDataModule
from datamodules.core.splits import SPLITS, Split, draw_groups
from datamodules.zind.homes import HomePanorama, list_home_panoramas
from datamodules.zind.layout import CLASSES, DOOR, Layout
from tangent_train.errors import DataError
from tangent_train.files import read_json

Doors = Literal["class", "ignore"]
"""Labels of doors: a class, or unknown."""


@data_set
class Zind(PanoramaDataModule):
    """ZInD, 5 classes.

    With ``zind_partition.json`` in `root`, it defines the splits. Without it, e.g. for the sample,
    complete rooms are drawn: a room is in one split only, although doorways show other rooms.

    Args:
        doors: `class`, or `ignore` to make doors unknown.
        test_fraction: Share of the rooms for the test, without a partition; 1 uses all rooms, to
            evaluate networks that were trained on other data.
        split_seed: Seed of the splits. Independent of the run's seed, so that runs with different
            seeds share their splits.
    """

    label_maps: ClassVar[Mapping[str, LabelMap]] = {"5": LabelMap.of(CLASSES)}
    no_depth = "ZInD has no depth images"
    fact_settings = ("doors",)

    inputs: Sequence[Input] = ("rgb",)
    doors: Doors = "class"
    test_fraction: Annotated[float, Field(gt=0, le=1)] = 0.2
    split_seed: NonNegativeInt = 0

    def files(self, split: Split) -> Sequence[ImageFiles]:
        """See `DataModule`."""
        return self._found[0][split]

    def decode_labels(self, files: ImageFiles) -> NDArray[np.uint8]:
        """Return the labels, cast for the size at which panoramas are read."""
        labels = self._found[1][files.name].labels(self.read_shape)
        if self.doors == "ignore":
            labels[labels == DOOR] = 0
        return labels

    def decode_settings(self) -> dict[str, Any]:
        """See `DataModule`."""
        return {**super().decode_settings(), "doors": self.doors}

    @cached_property
    def _found(self) -> tuple[dict[Split, list[ImageFiles]], dict[str, Layout]]:
        """Files of each split, and layouts by name of the panorama."""
        problems = self.problems
        panoramas = [p for p in list_home_panoramas(self.root, problems) if p.record.layout_visible]
        split_of = self._divided(panoramas)
        layouts: dict[str, Layout] = {}
        splits: dict[Split, list[ImageFiles]] = {split: [] for split in SPLITS}
        for panorama, split in zip(panoramas, split_of, strict=True):
            with problems.noted(panorama.name):
                layouts[panorama.name] = panorama.layout()
                files = ImageFiles(panorama.name, panorama.image, panorama.file)
                splits[split].append(files)
        if not self.val_fraction:
            splits["val"] = []
        return splits, layouts

    def _divided(self, panoramas: Sequence[HomePanorama]) -> list[Split]:
        """Return the split of every panorama."""
        partition = self.root / "zind_partition.json"
        homes = {panorama.home for panorama in panoramas}
        if partition.is_file():
            of_home = _read_partition(partition, homes)
            return [of_home[panorama.home] for panorama in panoramas]
        groups = [p.home if len(homes) > 1 else p.room for p in panoramas]
        test = set(groups)
        if self.test_fraction < 1:
            test = draw_groups(groups, self.test_fraction, [self.split_seed, 0])
        rest = [group for group in groups if group not in test]
        held: set[str] = set()
        if self.val_fraction:
            held = draw_groups(rest, self.val_fraction, [self.split_seed, 1])
        if not test or (rest and self.val_fraction and not held):
            raise DataError(
                self.root,
                found=f"{len(set(groups))} rooms or homes to draw from",
                expected="some for training, validation and test each",
                remedy="data.test_fraction=1 takes all for test, data.val_fraction=0 none "
                "for validation.",
            )
        return ["test" if g in test else "val" if g in held else "train" for g in groups]


def _read_partition(path: Path, homes: set[str]) -> dict[str, Split]:
    """Return the split of every home in a ``zind_partition.json``."""
    lists = read_json(path, "lists of homes for train, val and test", kind=dict[Split, list[str]])
    split_of = {home: split for split, homes_of_split in lists.items() for home in homes_of_split}
    missing = sorted(homes - split_of.keys())
    if missing:
        raise DataError(
            path,
            found=f"no home {', '.join(missing[:5])}",
            expected=f"every home of {path.parent} in one of its lists",
            remedy="Without the file, homes or rooms are drawn.",
        )
    return split_of
