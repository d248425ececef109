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

import math
from collections.abc import Mapping, Sequence
from dataclasses import field
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, NonNegativeInt, PositiveInt

from datamodules.core.data_module import data_set
from datamodules.core.files import ImageFiles, Problems, Split, draw_groups
from datamodules.core.image_module import PanoramaDataModule
from datamodules.core.label_map import LabelMap
from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPairs, read_whole
from datamodules.zind.homes import GET_IT, HomePanorama, list_home_panoramas
from datamodules.zind.layout import CLASSES, DOOR
from tangent_train.files import read_json


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

    label_maps = {"5": LabelMap.of(CLASSES, [0])}  # noqa: RUF012, never changed
    no_depth = "ZInD has no depth images"
    get_it = GET_IT
    fact_settings = cache_settings = ("doors",)

    doors: Literal["class", "ignore"] = "class"
    test_fraction: Annotated[float, Field(gt=0, le=1)] = 0.2
    split_seed: NonNegativeInt = 0

    def files(self) -> Mapping[Split, Sequence[ImageFiles]]:
        """See `DataModule`."""
        found = list_home_panoramas(self.root, self.problems)
        panoramas = [panorama for panorama in found if panorama.record.layout_visible]
        of_group = self._split_of_groups(panoramas)
        splits: dict[Split, list[ImageFiles]] = {"train": [], "val": [], "test": []}
        for one in panoramas:
            split = of_group[one.home] if one.home in of_group else of_group[one.room]
            splits[split].append(ImageFiles(one.name, one.rgb, one.file))
        return splits

    @cached_property
    def _by_name(self) -> dict[str, HomePanorama]:
        return {one.name: one for one in list_home_panoramas(self.root, Problems())}

    def _split_of_groups(self, panoramas: Sequence[HomePanorama]) -> dict[str, Split]:
        """Return the split of every home, or of every room of a single home."""
        partition = self.root / "zind_partition.json"
        if partition.is_file():
            kind = dict[Split, list[str]]
            lists = read_json(partition, "lists of homes for train, val and test", kind=kind)
            return {home: split for split, names in lists.items() for home in names}
        groups = {panorama.home for panorama in panoramas}
        if len(groups) == 1:
            groups = {panorama.room for panorama in panoramas}
        test, held = groups, set[str]()
        if self.test_fraction < 1:
            test = draw_groups(groups, self.test_fraction, [self.split_seed, 0]) or groups
        if self.val_fraction:
            held = draw_groups(groups - test, self.val_fraction, [self.split_seed, 1])
        return {g: "test" if g in test else "val" if g in held else "train" for g in groups}

    def check_files(self, files: ImageFiles) -> None:
        """See `DataModule`: the layout is a room around the camera, too."""
        super().check_files(files)
        self._by_name[files.name].layout()

    def decode_labels(self, files: ImageFiles) -> NDArray[np.uint8]:
        """See `ImageDataModule`; labels are cast at the size of the run, without resampling."""
        labels = self._by_name[files.name].layout().labels(self.read_shape)
        if self.doors == "ignore":
            labels[labels == DOOR] = 0
        return labels


@data_set
class ZindPairs(PanoramaPairs):
    """Any two panoramas of a complete room whose cameras are inside.

    Floors whose unit is unknown in meters have no pairs. Distances are those of floor,
    walls and ceiling of the layout; through doors, windows and openings they are unknown.

    Args:
        root: Folder with a folder for every home, see `datamodules.zind.panoramas`.
        max_distance_m: Largest distance between the cameras; by default unlimited.
        erp_height: Rows to downsample the panoramas to; by default unchanged.
    """

    root: Path = field(kw_only=False)
    max_distance_m: float | None = field(kw_only=False, default=None)
    erp_height: PositiveInt | None = None

    @cached_property
    def pairs(self) -> list[tuple[str, HomePanorama, HomePanorama]]:
        """See `PanoramaPairs`; names are the room and both panoramas.

        Raises:
            DataError: A file is broken.
        """
        problems = Problems()
        listed = list_home_panoramas(self.root, problems)
        problems.refuse(self.root)
        usable = [p for p in listed if p.record.layout_visible and p.record.is_inside and p.unit_m]
        location_m = {panorama.name: panorama.pose()[0].location_m for panorama in usable}
        pairs = []
        for one, other in combinations(usable, 2):
            away_m = math.dist(location_m[one.name], location_m[other.name])
            if one.room == other.room and away_m <= (self.max_distance_m or math.inf):
                left, right = (panorama.name.rpartition("/")[2] for panorama in (one, other))
                pairs.append((f"{one.room}/{left} – {right}", one, other))
        return pairs

    def panorama(self, files: HomePanorama) -> PairedPanorama:
        """See `PanoramaPairs`."""
        rgb = read_whole(files.rgb, self.erp_height)
        pose, unit_m = files.pose()
        distance_m = (files.layout().distances(rgb.shape[:2]) * unit_m).astype(np.float32)
        return PairedPanorama(files.name, rgb, distance_m, pose)
