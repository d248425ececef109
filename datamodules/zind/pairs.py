"""Pairs of ZInD's panoramas of one room, with their poses, and distances from their layouts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path

import numpy as np

from datamodules.core.panorama_pairs import PairedPanorama, PanoramaPairs, paired_shape
from datamodules.core.problems import Problems
from datamodules.zind.homes import HomePanorama, list_home_panoramas
from tangent_train.errors import DataError
from tangent_train.io.pixel_files import read_rgb
from tangent_train.rendering.resampling import resize


@dataclass(eq=False)
class ZindPairs(PanoramaPairs):
    """Any two panoramas of a complete room whose cameras are inside.

    Floors whose unit is unknown in meters have no pairs. Distances are those of floor,
    walls and ceiling of the layout; through doors, windows and openings they are unknown.

    Args:
        root: Folder with a folder for every home, see `datamodules.zind.panoramas`.
        max_distance_m: Largest distance between the cameras; by default unlimited.
        erp_height: Rows to downsample the panoramas to; by default unchanged.
    """

    root: str | Path
    max_distance_m: float | None = None
    erp_height: int | None = None

    @cached_property
    def pairs(self) -> list[tuple[str, HomePanorama, HomePanorama]]:
        """See `PanoramaPairs`; names are the room and both panoramas.

        Raises:
            DataError: There are no pairs, or a file is broken.
        """
        problems, root = Problems(), Path(self.root)
        most_m = math.inf if self.max_distance_m is None else self.max_distance_m
        listed = list_home_panoramas(root, problems)
        problems.refuse(root)
        usable = [p for p in listed if p.record.layout_visible and p.record.is_inside and p.unit_m]
        location_m = {panorama.name: panorama.pose()[0].location_m for panorama in usable}
        pairs = [
            (
                f"{one.room}/{one.name.rpartition('/')[2]} – {other.name.rpartition('/')[2]}",
                one,
                other,
            )
            for one, other in combinations(usable, 2)
            if one.room == other.room
            and math.dist(location_m[one.name], location_m[other.name]) <= most_m
        ]
        if not pairs:
            raise DataError(
                root,
                found="no two panoramas of one room",
                expected="layout_visible, is_inside and scale_meters_per_coordinate of some",
                remedy="Set data.max_distance_m=null for any distance.",
            )
        return pairs

    def image(self, files: HomePanorama) -> Path:
        """See `PanoramaPairs`."""
        return files.image

    def panorama(self, files: HomePanorama) -> PairedPanorama:
        """See `PanoramaPairs`."""
        path = files.image
        rgb = read_rgb(path)
        shape = paired_shape(path, rgb, self.erp_height)
        pose, unit_m = files.pose()
        distance_m = (files.layout().distances(shape) * unit_m).astype(np.float32)
        return PairedPanorama(files.name, resize(rgb, shape, "bilinear"), path, distance_m, pose)
